"""Variants: each demonstration rendered in several looks, as data; light to import.

    render_demos(demos, out, variants=Variants("train", count=5))

A look affects only what is seen (docs/looks.md), so a demonstration that was recorded once can be
rendered in any number of looks. All other columns are the same in every variant, unless cameras and
joints are off in it (`shift`): then what the arms report is off, too. The look of a variant is
drawn from the demonstration's recorded states and the variant's number, whatever look it was
recorded in. The dataset holds all variants of the first demonstration, then all of the second, and
so on. `demonstration_index` says which frames show the same demonstration; every split and every
count of demonstrations uses it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from surgicai_vision.core.config import JSON, LATER, RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError, check_at_least


@dataclass(frozen=True)
class Variants:
    """The looks in which each demonstration is rendered.

    Attributes:
        appearance: as in `RandomisationConfig`: a family or a set of families ("train"); "" keeps
            the recorded look.
        distractors: as in `RandomisationConfig`: largest number of distractor objects; 0 keeps what
            was recorded.
        count: variants of each demonstration.
        corruption: largest strength of smoke, blur and pixel noise on the images
            (`core.corruption`), 0 to 1; each variant draws a strength of each, uniform from 0.
        shift: strength, 0 to 1, by which cameras, their fields of view, lights, tints and joints
            are off (`core.shifts.RENDERED`); each variant draws how far, instead of what was
            recorded.
        aimed: crops lie where a detector would see the jaws (`docs/detection.md`), which is about
            the true ones, not where the arm reports them.

    Raises:
        InputError: nothing to draw, fewer than one variant, or a strength out of its range.
        UnknownName: no such appearance.
    """

    appearance: str = ""
    distractors: int = 0
    count: int = 1
    corruption: float = 0.0
    shift: float = field(default=0.0, metadata=LATER)
    aimed: bool = field(default=False, metadata=LATER)

    def __post_init__(self) -> None:
        RandomisationConfig(appearance=self.appearance, distractors=self.distractors)
        check_at_least(1, variants=self.count)
        for name in ("corruption", "shift"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} is {getattr(self, name)}; allowed: 0 to 1.")
        if not (self.appearance or self.distractors or self.corruption or self.shift or self.aimed):
            raise InputError(
                f"{self.count} variants are requested without a look to draw; give an appearance "
                "(--appearance train), distractors (--distractors 5), a corruption (--corruption "
                "0.5), a shift (--shift 0.5) or --aimed."
            )

    @classmethod
    def asked(
        cls,
        appearance: str,
        distractors: int,
        count: int,
        corruption: float,
        shift: float,
        aimed: bool,
    ) -> "Variants | None":
        """Return the variants; None for one in which nothing is drawn: each as it was recorded.

        Raises:
            InputError, UnknownName: as the class does.
        """
        if count == 1 and not (appearance or distractors or corruption or shift or aimed):
            return None
        return cls(appearance, distractors, count, corruption, shift, aimed)

    def shown(self, config: TaskConfig) -> TaskConfig:
        """Return the task as it looks in the variants, corruption and shift aside."""
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
        parts += [f"corruption{self.corruption:g}"] if self.corruption else []
        parts += [f"shift{self.shift:g}"] if self.shift else []
        parts += ["aimed"] if self.aimed else []
        return "-".join([*parts, f"x{self.count}"])

    @property
    def text(self) -> str:
        """What they are, in words."""
        looks = f"{self.count} {'look' if self.count == 1 else 'looks'}"
        parts = [f"({self.appearance})"] if self.appearance else []
        parts += [f"with up to {self.distractors} distractors"] if self.distractors else []
        if self.corruption:
            parts += [f"behind smoke, blur and noise of up to {self.corruption:.0%}"]
        if self.shift:
            parts += [f"with cameras, lights and joints off by strength {self.shift:g}"]
        parts += ["with aimed crops"] if self.aimed else []
        return " ".join([looks, *parts])

    @property
    def request(self) -> Mapping[str, JSON]:
        """Return what they are as plain data."""
        asked: dict[str, JSON] = {
            "appearance": self.appearance,
            "distractors": self.distractors,
            "corruption": self.corruption,
            "shift": self.shift,
            "aimed": self.aimed,
        }
        return {**{key: value for key, value in asked.items() if value}, "count": self.count}
