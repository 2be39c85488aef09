"""Untrusted plain data: text → JSON, and JSON → the types that a reader needs; else `BadFile`.

    row = checked(parse_json(line, where), dict, where)
    fps = finite_number(row.get("fps"), f"{where}: fps")

Whole files are read with `core.files.read_json`.
"""

import json
import math
from collections.abc import Mapping
from types import MappingProxyType

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import BadFile, shown

KINDS: Mapping[type, str] = MappingProxyType(
    {dict: "a table of keys", list: "a list", str: "text", int: "a whole number"}
)
"""Type → its name in messages."""


def parse_json(text: str, where: str) -> JSON:
    """Return the JSON of a text.

    Args:
        text: one value of JSON.
        where: where the text is from, for the message.

    Raises:
        BadFile: it is not JSON, or is nested too deeply.
    """
    try:
        value: JSON = json.loads(text)
    except RecursionError:
        raise BadFile(f"{where} is refused: its JSON is nested too deeply.") from None
    except ValueError as error:
        raise BadFile(f"{where} is not valid JSON ({error}).") from None
    return value


def checked[T](value: object, kind: type[T], where: str) -> T:
    """Return a value that must be of one of the `KINDS`.

    Args:
        value: what a file holds.
        kind: the type that it must have.
        where: the file and the place in it, for the message.

    Raises:
        BadFile: it is of another type.
    """
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise BadFile(f"{where} is {shown(value)}; it must be {KINDS[kind]}.")
    return value


def finite_number(value: object, where: str) -> float:
    """Return a value that must be a finite number.

    Args:
        value: what a file holds.
        where: the file and the place in it, for the message.

    Raises:
        BadFile: it is not a finite number, or too large for one.
    """
    try:
        if isinstance(value, int | float) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer of hundreds of digits
        pass
    raise BadFile(f"{where} is {shown(value)}; it must be a finite number.")
