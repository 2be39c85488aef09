"""Selection: the runs of a grid that one call works on, by its axes (`sweep --only`).

A choice maps an axis to values as text: several views are joined by "+", and "none" stands for a
run without a value.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.experiments.sweep.grid import AXES
from surgicai_vision.training.run_config import RunConfig

CHOICES: Mapping[str, Callable[[RunConfig], object]] = MappingProxyType(
    {**AXES, "condition": lambda run: run.condition or None}
)
"""What runs are chosen by, and a run's value: the axes of a grid, and the condition of a plan."""

Choice = Mapping[str, frozenset[str]]
EVERYTHING: Choice = {}
NONE = "none"


def read_choice(texts: Iterable[str], runs: Sequence[RunConfig]) -> Choice:
    """Read `encoder=imagenet`, `random`, `seed=0`.

    A text without an axis is another value of the axis before it.

    Raises:
        UnknownName: an axis, or a value of it, that no run has.
        InputError: a value before the first axis.
    """
    choice: dict[str, set[str]] = {}
    axis = ""
    for text in texts:
        before, sign, value = text.partition("=")
        axis = check_name("axis", before, CHOICES) if sign else axis
        if not axis:
            raise InputError(f"--only {text}: give AXIS=VALUE,VALUE; axes: {', '.join(CHOICES)}.")
        known = sorted({_value(run, axis) for run in runs})
        choice.setdefault(axis, set()).add(check_name(axis, value if sign else text, known))
    return {axis: frozenset(values) for axis, values in choice.items()}


def is_chosen(run: RunConfig, choice: Choice) -> bool:
    """Return True if a run has one of the chosen values on every axis of `choice`."""
    return all(_value(run, axis) in values for axis, values in choice.items())


def _value(run: RunConfig, axis: str) -> str:
    """Return a run's place on an axis in words."""
    value = CHOICES[axis](run)
    if isinstance(value, tuple):
        return "+".join(value) or NONE
    return NONE if value is None else str(value)
