"""Variants: each demonstration rendered in several looks, as data; light to import.

    render_demos(demos, out, variants=Variants("train", count=5))

A look is part of the drawn state and nothing but seen (docs/looks.md), so what was recorded once
can be rendered in as many looks as wanted: the columns of all variants are the same. The look of a
variant is drawn from the demonstration's file and the variant's number, whatever look it was
recorded in. The dataset holds all variants of the first demonstration, then all of the second …;
`demonstration_index` says which frames show the same one, and every split and count of
demonstrations goes by it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from surgicai_vision.core.config import JSON, RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError, check_at_least


@dataclass(frozen=True)
class Variants:
    """The looks in which each demonstration is rendered.

    Attributes:
        appearance: of `RandomisationConfig`: a family, "train" or "heldout"; "" leaves the look as
            it was recorded.
        distractors: of `RandomisationConfig`: most things that lie about; 0 leaves what was
            recorded.
        count: variants of each demonstration.

    Raises:
        InputError: no look to draw, or fewer than one variant.
        UnknownName: no such appearance.
    """

    appearance: str = ""
    distractors: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        RandomisationConfig(appearance=self.appearance, distractors=self.distractors)
        check_at_least(1, variants=self.count)
        if not (self.appearance or self.distractors):
            raise InputError(
                f"{self.count} variants are asked without a look to draw; give an appearance "
                "(--appearance train) or distractors (--distractors 5)."
            )

    @property
    def axes(self) -> Mapping[str, str | int]:
        """Return axis of randomisation → what it is drawn from, of those that are drawn."""
        asked: dict[str, str | int] = {
            "appearance": self.appearance,
            "distractors": self.distractors,
        }
        return {axis: value for axis, value in asked.items() if value}

    def shown(self, config: TaskConfig) -> TaskConfig:
        """Return the task as it looks in the variants."""
        own = config.randomisation
        return replace(
            config,
            randomisation=replace(
                own,
                appearance=self.appearance or own.appearance,
                distractors=self.distractors or own.distractors,
            ),
        )

    @property
    def name(self) -> str:
        """What they are, as a part of a name: "train-x5"."""
        parts = [self.appearance] if self.appearance else []
        parts += [f"distractors{self.distractors}"] if self.distractors else []
        return "-".join([*parts, f"x{self.count}"])

    @property
    def text(self) -> str:
        """What they are, in words."""
        looks = f"{self.count} {'look' if self.count == 1 else 'looks'}"
        parts = [f"({self.appearance})"] if self.appearance else []
        parts += [f"with up to {self.distractors} distractors"] if self.distractors else []
        return " ".join([looks, *parts])

    @property
    def request(self) -> Mapping[str, JSON]:
        """Return what they are as plain data."""
        return {**self.axes, "count": self.count}
