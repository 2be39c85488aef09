"""Errors: a message says what was given, what is allowed and what to do next.

The command line maps them to exit codes: `InputError` (wrong input) ends with 2, every other
`SurgicaiError` (the work failed) with 1; both print one line and no traceback.
"""

import difflib
from collections.abc import Iterable


class SurgicaiError(Exception):
    """Base of all errors that this package raises: one line, no traceback, exit code 1."""

    exit_code = 1


class InputError(SurgicaiError):
    """Input that cannot be used. Exit code 2."""

    exit_code = 2


class UnknownName(InputError):
    """A name outside a closed list; the message lists what exists and suggests the nearest.

    Args:
        kind: what the name stands for, in one word ("camera", "encoder").
        given: the name as given.
        allowed: every name that exists.
    """

    def __init__(self, kind: str, given: object, allowed: Iterable[str]):
        names = sorted(allowed)
        near = difflib.get_close_matches(str(given), names, n=1, cutoff=0.5)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        super().__init__(f"Unknown {kind} '{given}'.{hint} Allowed: {', '.join(names)}.")


class BadFile(InputError):
    """A file or folder that is missing, unreadable, damaged or of another kind than asked."""


class OutputExists(InputError):
    """An output path that already holds something this command did not make."""


class MissingWeights(InputError):
    """Pretrained weights that are neither on this machine nor downloadable."""


class UnreachablePose(SurgicaiError):
    """A tool pose outside the arm's joint limits or workspace."""


class PhysicsError(SurgicaiError):
    """The simulation diverged or was started from an impossible state."""


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, or its type's name where it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def check_name(kind: str, given: str, allowed: Iterable[str]) -> str:
    """Return `given` if it is one of `allowed`, else raise `UnknownName`."""
    names = tuple(allowed)
    if given not in names:
        raise UnknownName(kind, given, names)
    return given


def check_at_least(least: int, **numbers: float | None) -> None:
    """Refuse numbers below `least`; None is no number.

    Args:
        least: the smallest that is allowed.
        numbers: what each is called, and its value.

    Raises:
        InputError: a number below, or none at all (NaN).
    """
    for name, number in numbers.items():
        if number is not None and not number >= least:
            raise InputError(f"{name} is {number}; it must be at least {least}.")


def check_positive(**numbers: float) -> None:
    """Refuse numbers that are not above 0.

    Raises:
        InputError: a number that is 0, below, or none at all (NaN).
    """
    for name, number in numbers.items():
        if not number > 0:
            raise InputError(f"{name} is {number}; it must be above 0.")
