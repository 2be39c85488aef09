"""What a quickstart does, as data; light to import, for the command line."""

from dataclasses import dataclass

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.features import encoders
from surgicai_vision.training.run_config import RunConfig


@dataclass(frozen=True)
class PolicyChoice:
    """A policy's inputs: an encoder with its views, or neither for proprioception alone."""

    encoder: str | None = None
    view: tuple[str, ...] = ()


@dataclass(frozen=True)
class Quickstart:
    """What a quickstart does; the defaults are configs/quickstart.yaml.

    Attributes:
        task: the task.
        demonstrations: expert demonstrations to train on.
        view: rendered views.
        size: height and width of images [px].
        depth: render depth beside RGB.
        recipe: recipe of behaviour cloning.
        policies: what is trained and evaluated.
        episodes: held-out starts of each evaluation.
        seed: training seed.
    """

    task: str = "grasp"
    demonstrations: int = 25
    view: tuple[str, ...] = ("front", "back")
    size: int = 224
    depth: bool = True
    recipe: str = "paper"
    policies: tuple[PolicyChoice, ...] = (
        PolicyChoice("imagenet-lite", ("front",)),
        PolicyChoice("imagenet-lite", ("back",)),
        PolicyChoice("random", ("back",)),
        PolicyChoice(),
    )
    episodes: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        for run in self.runs:
            if run.encoder:
                encoders.check_encoder_name(run.encoder)
            for view in run.views:
                check_name("rendered view", view, self.view)
        numbers = {
            "demonstrations": self.demonstrations,
            "size": self.size,
            "episodes": self.episodes,
        }
        for name, number in numbers.items():
            if number < 1:
                raise InputError(f"{name} is {number}; it must be at least 1.")

    @property
    def runs(self) -> list[RunConfig]:
        """One run a policy."""
        return [
            RunConfig(
                TaskConfig(self.task),
                choice.encoder,
                choice.view,
                recipe=self.recipe,
                demonstrations=self.demonstrations,
                demonstrator="expert",
                seed=self.seed,
            )
            for choice in self.policies
        ]
