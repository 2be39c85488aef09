"""What a quickstart does, as data; light to import, for the command line."""

from dataclasses import dataclass

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.experiments.run import Cell
from surgicai_vision.features import encoders


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
        for cell in self.cells:
            if cell.encoder:
                encoders.check_encoder_name(cell.encoder)
            for view in cell.view:
                check_name("rendered view", view, self.view)
        for name in ("demonstrations", "size", "episodes"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least 1.")

    @property
    def cells(self) -> list[Cell]:
        """The policies as cells."""
        return [
            Cell(self.task, choice.encoder, choice.view, self.seed, recipe=self.recipe)
            for choice in self.policies
        ]
