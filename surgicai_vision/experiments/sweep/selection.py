"""Choosing: the cells of a grid that one call works on, by the values of its axes (`sweep --only`).

A choice maps an axis to values in words: those of `view` are joined by "+", what a cell has none of
is "none".
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.experiments.run import Cell
from surgicai_vision.experiments.sweep.grid import AXES

Choice = Mapping[str, frozenset[str]]
EVERYTHING: Choice = {}
NONE = "none"


def read_choice(texts: Iterable[str], cells: Sequence[Cell]) -> Choice:
    """Read `encoder=imagenet`, `random`, `seed=0`: a text without an axis is another value of the
    axis before it.

    Raises:
        UnknownName: an axis, or a value of it, that no cell has.
        InputError: a value before the first axis.
    """
    choice: dict[str, set[str]] = {}
    axis = ""
    for text in texts:
        before, sign, value = text.partition("=")
        axis = check_name("axis", before, AXES) if sign else axis
        if not axis:
            raise InputError(f"--only {text}: give AXIS=VALUE,VALUE; axes: {', '.join(AXES)}.")
        known = sorted({_value(cell, axis) for cell in cells})
        choice.setdefault(axis, set()).add(check_name(axis, value if sign else text, known))
    return {axis: frozenset(values) for axis, values in choice.items()}


def is_chosen(cell: Cell, choice: Choice) -> bool:
    """Return whether a cell has one of the values of every axis that is chosen by."""
    return all(_value(cell, axis) in values for axis, values in choice.items())


def _value(cell: Cell, axis: str) -> str:
    """Return a cell's place on an axis in words."""
    value: Any = getattr(cell, axis)
    if isinstance(value, tuple):
        return "+".join(value) or NONE
    return NONE if value is None else str(value)
