"""What a quickstart does, as data; light to import, for the command line."""

from dataclasses import dataclass

from surgicai_vision.core.config import TaskConfig, check_frame_stride
from surgicai_vision.core.errors import InputError, check_at_least
from surgicai_vision.experiments.dataset_config import DatasetConfig, Demonstrations
from surgicai_vision.features import encoders
from surgicai_vision.training.run_config import RunConfig


@dataclass(frozen=True)
class PolicyChoice:
    """A policy to train.

    Attributes:
        encoder: its encoder; None, and no views, for proprioception alone.
        view: its views.
        pool: what is taken from the encoder.
        recipe: the recipe of behaviour cloning.
        change: what is changed in the recipe, "key=value" each.
    """

    encoder: str | None = None
    view: tuple[str, ...] = ()
    pool: str = "global"
    recipe: str = "paper"
    change: tuple[str, ...] = ()


@dataclass(frozen=True)
class Quickstart:
    """What a quickstart does; the defaults are those of configs/quickstart.yaml.

    Attributes:
        procedure: who sews the whole procedure of the first act; None leaves it out.
        task: the task of the second act.
        demonstrations: expert demonstrations to train on.
        noise: noise on the actions that the expert executes.
        view: rendered views.
        size: height and width of images [px].
        frame_stride: control steps from frame to frame.
        policies: what is trained and evaluated; the first one is in the headline.
        episodes: held-out starts of each evaluation.
        seed: training seed.
    """

    procedure: str | None = "released:suture"
    task: str = "handoff"
    demonstrations: int = 120
    noise: float = 0.6
    view: tuple[str, ...] = ("front_psm1", "back_psm1", "back")
    size: int = 224
    frame_stride: int = 5
    policies: tuple[PolicyChoice, ...] = (
        PolicyChoice("imagenet-lite-early", ("front_psm1", "back_psm1"), "spatial", "best"),
        PolicyChoice("imagenet-lite", ("back",), change=("frame_stride=5",)),
        PolicyChoice(change=("frame_stride=5",)),
    )
    episodes: int = 50
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.policies:
            raise InputError("policies is empty; give at least one; {} is a policy without images.")
        check_frame_stride(self.frame_stride)
        if not 0.0 <= self.noise <= 1.0:
            raise InputError(f"noise is {self.noise:g}; it must be between 0 and 1.")
        names = [run.name for run in self.runs]
        for name in names:
            if names.count(name) > 1:
                raise InputError(
                    f"policies: two are called '{name}'; recipes of files need different names."
                )
        for run in self.runs:
            if run.encoder:
                encoders.check_encoder_name(run.encoder)
            for view in run.views:
                if view not in self.view:
                    raise InputError(
                        f"view is {','.join(self.view)}, and policy {run.name} sees '{view}'; add "
                        "it, or give other policies in a --config file (configs/quickstart.yaml)."
                    )
        check_at_least(
            1, demonstrations=self.demonstrations, size=self.size, episodes=self.episodes
        )

    @property
    def dataset(self) -> DatasetConfig:
        """The dataset of all policies."""
        recorded = Demonstrations(
            self.task,
            self.task,
            self.demonstrations,
            self.view,
            noise=self.noise,
            frame_stride=self.frame_stride,
        )
        return DatasetConfig(TaskConfig(self.task), recorded, self.size)

    @property
    def runs(self) -> list[RunConfig]:
        """One run per policy."""
        return [
            RunConfig(
                TaskConfig(self.task),
                choice.encoder,
                choice.view,
                pool=choice.pool,
                recipe=choice.recipe,
                changes=choice.change,
                demonstrations=self.demonstrations,
                demonstrator="expert",
                noise=self.noise,
                frame_stride=self.frame_stride,
                seed=self.seed,
            )
            for choice in self.policies
        ]
