"""Dependence: which numbers of the randomisation the failures of a policy depend on.

    found = dependences(groups)      # one `Dependence` for each condition and quantity
    rows(found)                      # what the page says of each condition

Every episode's numbers are drawn again from its seed (`envs.randomisation.drawn`). A quantity, such
as the needle's radius, divides the starts of a condition: a choice by what was chosen, a number
into thirds. A permutation test says whether the parts succeed alike, with Holm's correction over
the quantities of the condition. A start that several training seeds were evaluated on counts once,
with the mean of its successes.

Only conditions with at least `FEW` starts that fail and `FEW` that succeed are looked at.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig
from surgicai_vision.envs import randomisation
from surgicai_vision.evaluation import statistics
from surgicai_vision.report import text
from surgicai_vision.report.groups import Group

FEW = 5
"""Fewest starts that fail, and that succeed, for the failures to be looked at."""
NO_BREAK = "\u00a0"
SURE = 0.05
"""Largest corrected p-value at which failures are said to depend on a quantity."""

Array = NDArray[np.float64]
Numbers = Mapping[str, Array | int]
"""Axis → the numbers of one episode, as `info["randomisation"]` has them."""


# -- quantities ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """What is measured of the numbers that an episode has on one axis.

    Attributes:
        name: in words.
        unit: of its numbers; "" where it is a choice.
        of: the axis's numbers → a number, or the name of a choice.
    """

    name: str
    unit: str
    of: Callable[[Array], float | str]


def _percent(values: Array) -> float:
    return 100.0 * float(values[0])


def _distance(values: Array) -> float:
    return 1e3 * float(np.linalg.norm(values))


LOOKS = ("plain", *names.APPEARANCES)
QUANTITIES: Mapping[str, tuple[Quantity, ...]] = MappingProxyType(
    {
        "needle_size": (Quantity("needle radius", "%", _percent),),
        "needle_thickness": (Quantity("needle thickness", "%", _percent),),
        "needle_arc": (
            Quantity("needle arc", "", lambda values: randomisation.arc_name(float(values[0]))),
        ),
        "phantom_shift": (Quantity("shift of the phantom", "mm", _distance),),
        "phantom_turn": (
            Quantity("turn of the phantom", "°", lambda values: float(np.degrees(values[0]))),
        ),
        "pair": (Quantity("pair of holes", "", lambda values: f"{values[0]:.0f}"),),
        "robot_start": (
            Quantity("shift of PSM1", "mm", lambda values: _distance(values[:3])),
            Quantity("shift of PSM2", "mm", lambda values: _distance(values[3:])),
        ),
        "appearance": (Quantity("look", "", lambda values: LOOKS[int(values[0])]),),
        "distractors": (Quantity("distractors", "", lambda values: f"{values[0]:.0f}"),),
    }
)
"""Axis → what is measured of its numbers. Of every other axis with numbers in units (light, colour,
cameras, friction, joints) it is their root mean square, in percent of the most that is drawn."""


def quantities(config: RandomisationConfig) -> dict[str, tuple[Quantity, ...]]:
    """Return axis → what is measured of its numbers, for the axes that are on in `config`."""
    return {
        axis: QUANTITIES.get(axis) or (_root_mean_square(axis, getattr(config, axis)),)
        for axis in config.on
        if axis in QUANTITIES or axis in randomisation.UNITS
    }


def _root_mean_square(axis: str, magnitude: float) -> Quantity:
    most = magnitude * np.array(randomisation.UNITS[axis])
    return Quantity(
        axis.replace("_", " "),
        "%",
        lambda values: 100.0 * float(np.sqrt(np.mean((values / most) ** 2))),
    )


# -- dependences -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """Starts that are alike in one quantity.

    Attributes:
        name: what was chosen, or the smallest and the largest value with their unit.
        successes: episodes that succeeded.
        episodes: all of them.
    """

    name: str
    successes: int
    episodes: int


@dataclass(frozen=True)
class Dependence:
    """How the successes of a condition depend on one quantity.

    Attributes:
        group: the condition.
        quantity: what differs from start to start, in words.
        parts: the starts, divided by it, in order of its value.
        p: p-value of the permutation test (`statistics.differ`).
        adjusted: p-value after Holm's correction over the condition's quantities.
    """

    group: Group
    quantity: str
    parts: tuple[Part, ...]
    p: float
    adjusted: float


@dataclass(frozen=True)
class _Start:
    """A start of a condition: what was drawn for it, and its success for each training seed."""

    drawn: Numbers
    successes: tuple[bool, ...]

    @property
    def rate(self) -> float:
        return sum(self.successes) / len(self.successes)


def dependences(groups: Sequence[Group]) -> list[Dependence]:
    """Return how each condition depends on each quantity that its starts differ in."""
    found: list[Dependence] = []
    for item in groups:
        for config in {result.config.randomisation for result in item.results}:
            starts = _starts(item, config)
            failed = sum(not all(start.successes) for start in starts)
            succeeded = sum(any(start.successes) for start in starts)
            if min(failed, succeeded) >= FEW:
                found += _dependences_of(item, config, starts)
    return found


def _starts(item: Group, config: RandomisationConfig) -> list[_Start]:
    """Return a condition's starts in one world."""
    successes: dict[int, list[bool]] = defaultdict(list)
    for result in item.results:
        if result.config.randomisation == config:
            for row in result.rows:
                successes[int(row["seed"])].append(bool(row["success"]))
    return [
        _Start(randomisation.drawn(config, seed), tuple(won))
        for seed, won in sorted(successes.items())
    ]


def _dependences_of(
    item: Group, config: RandomisationConfig, starts: Sequence[_Start]
) -> Iterator[Dependence]:
    divided = [
        (quantity, parts)
        for axis, found in quantities(config).items()
        for quantity in found
        if len(parts := _divided(quantity, axis, starts)) > 1
    ]
    generator = np.random.default_rng(0)
    chances = [
        statistics.differ([[start.rate for start in part] for _, part in parts], generator)
        for _, parts in divided
    ]
    for (quantity, parts), p, adjusted in zip(
        divided, chances, statistics.holm(chances), strict=True
    ):
        counted = tuple(
            Part(
                name,
                sum(sum(start.successes) for start in part),
                sum(len(start.successes) for start in part),
            )
            for name, part in parts
        )
        yield Dependence(item, quantity.name, counted, p, adjusted)


def _divided(
    quantity: Quantity, axis: str, starts: Sequence[_Start]
) -> list[tuple[str, list[_Start]]]:
    """Return the starts in parts, each with its choice or its range; none if all are alike."""
    values = [quantity.of(np.atleast_1d(start.drawn[axis])) for start in starts]
    order = sorted(range(len(starts)), key=values.__getitem__)
    if not quantity.unit:
        chosen: dict[str, list[_Start]] = defaultdict(list)
        for place in order:
            chosen[str(values[place])].append(starts[place])
        return list(chosen.items())
    if len(set(values)) < 3:
        return []
    return [
        (
            f"{values[third[0]]:.2g} to {values[third[-1]]:.2g} {quantity.unit}",
            [starts[place] for place in third],
        )
        for third in np.array_split(order, 3)
    ]


# -- words -----------------------------------------------------------------------------------------


def rows(found: Sequence[Dependence]) -> list[tuple[str, ...]]:
    """Return task, policy, quantity, successes of each part and the corrected p-value, as text.

    A condition has a row for each quantity that its failures depend on; if there is none, a row for
    the one with the smallest p-value, which says so.
    """
    by_group: dict[int, list[Dependence]] = defaultdict(list)
    for item in found:
        by_group[id(item.group)].append(item)
    made: list[tuple[str, ...]] = []
    for items in by_group.values():
        ordered = sorted(items, key=lambda item: (item.adjusted, item.p))
        sure = [item for item in ordered if item.adjusted < SURE]
        for item in sure or ordered[:1]:
            counts = [f"{part.name}: {part.successes}/{part.episodes}" for part in item.parts]
            parts = "; ".join(count.replace(" ", NO_BREAK).replace("-", "−") for count in counts)
            words = item.quantity if sure else f"none of {len(items)}; nearest: {item.quantity}"
            condition = item.group.condition
            p = text.probability(item.adjusted)
            made.append((condition.task, item.group.label, words, parts, p))
    return made


def records(found: Sequence[Dependence]) -> list[dict[str, object]]:
    """Return one flat row for each part, for `tables/dependence.csv`."""
    return [
        {
            "task": item.group.condition.task,
            "policy": item.group.label,
            "quantity": item.quantity,
            "part": part.name,
            "successes": part.successes,
            "episodes": part.episodes,
            "p": item.p,
            "holm_p": item.adjusted,
        }
        for item in found
        for part in item.parts
    ]
