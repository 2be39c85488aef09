"""Errors: a message says what was given, what is allowed and what to do next.

The command line maps them to exit codes: `InputError` (wrong input) ends with 2, every other
`SurgicaiError` (the work failed) with 1; both print one line and no traceback.
"""

import difflib
import math
import reprlib
from collections.abc import Iterable
from typing import final

INTERRUPTED = "interrupted; run the same command again"
"""What the command line says after Ctrl-C."""
SHOWN_BITS = 4096
"""An integer of more bits is shown as its bit count: Python refuses to print the longest ones."""


class SurgicaiError(Exception):
    """Base of all errors that this package raises: one line, no traceback, exit code 1."""

    exit_code = 1

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the message: a subclass may build it from other arguments."""
        return _with_message, (type(self), self.args), self.__dict__


def _with_message(kind: type[SurgicaiError], arguments: tuple[object, ...]) -> SurgicaiError:
    """Return an error as it was pickled: with its arguments, and without a call of `__init__`."""
    return kind.__new__(kind, *arguments)


class InputError(SurgicaiError):
    """Input that cannot be used. Exit code 2."""

    exit_code = 2


class UnknownName(InputError):
    """A name outside a closed list; the message lists what exists and suggests the nearest.

    Args:
        kind: what the name refers to, in one word ("camera", "encoder").
        given: the name as given.
        allowed: every name that exists.
    """

    def __init__(self, kind: str, given: object, allowed: Iterable[str]):
        names = sorted(allowed)
        near = difflib.get_close_matches(str(given), names, n=1, cutoff=0.5)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        super().__init__(f"Unknown {kind} '{given}'.{hint} Allowed: {', '.join(names)}.")


class BadFile(InputError):
    """A file or folder that is missing, unreadable, damaged or of another kind than expected."""


class OutputExists(InputError):
    """An output path that already holds something this command did not make."""


class MissingWeights(InputError):
    """Pretrained weights that are neither on this machine nor downloadable."""


class UnreachablePose(SurgicaiError):
    """A tool pose outside the arm's joint limits or workspace."""


class PhysicsError(SurgicaiError):
    """The simulation diverged or was started from an impossible state."""


@final
class _Short(reprlib.Repr):
    """Shows the beginning of a value, however large it is."""

    def __init__(self) -> None:
        super().__init__(maxlevel=2, maxlist=4, maxtuple=4, maxdict=4, maxstring=80, maxother=80)

    def repr_int(self, x: int, level: int) -> str:
        if x.bit_length() > SHOWN_BITS:
            return f"<integer of {x.bit_length()} bits>"
        return super().repr_int(x, level)


_SHORT = _Short()


def shown(value: object) -> str:
    """Return a value of a file as messages show it: its beginning, however large it is."""
    return _SHORT.repr(value)


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
    """Refuse numbers below `least`; None is skipped.

    Args:
        least: the smallest allowed value.
        numbers: the name and the value of each.

    Raises:
        InputError: a number below `least`, or NaN.
    """
    for name, number in numbers.items():
        if number is not None and not number >= least:
            raise InputError(f"{name} is {number}; it must be at least {least}.")


def check_at_most(most: int, **numbers: float | None) -> None:
    """Refuse numbers above `most`; None is skipped.

    Args:
        most: the largest allowed value.
        numbers: the name and the value of each.

    Raises:
        InputError: a number above `most`, or NaN.
    """
    for name, number in numbers.items():
        if number is not None and not number <= most:
            raise InputError(f"{name} is {shown(number)}; it must be at most {most}.")


def check_finite(**numbers: float) -> None:
    """Refuse numbers that are infinite or NaN.

    Args:
        numbers: the name and the value of each.

    Raises:
        InputError: a number is infinite or NaN.
    """
    for name, number in numbers.items():
        if not math.isfinite(number):
            raise InputError(f"{name} is {number}; give a finite number.")


def check_positive(**numbers: float) -> None:
    """Refuse numbers that are not above 0.

    Raises:
        InputError: a number that is 0, negative or NaN.
    """
    for name, number in numbers.items():
        if not number > 0:
            raise InputError(f"{name} is {number}; it must be above 0.")
