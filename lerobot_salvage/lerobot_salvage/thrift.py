"""Thrift's compact protocol, as far as parquet's footers and page headers need it.

    fields, end = read_struct(content, start)        # {field id: (type, value)}
    content = write_struct(fields)

A struct is a table of field id → (type, value); a list is (element type, [values]). Reading checks
every length against the content, so foreign bytes cause a `ValueError`, never a hang or an overrun.
"""

import mmap
import struct
from typing import Any, Final

TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
"""Types of the compact protocol (thrift-compact-protocol.md, parquet-format 2.9)."""

Content = bytes | mmap.mmap
Fields = dict[int, tuple[int, Any]]

DEEPEST: Final = 32
"""Maximum nesting of structs and lists; parquet's footer has 6 levels."""


def read_struct(content: Content, position: int, depth: int = 0) -> tuple[Fields, int]:
    """Read the struct at `position`; return its fields and the position after it.

    Raises:
        ValueError: the bytes are not a struct.
    """
    fields: Fields = {}
    last = 0
    while True:
        header, position = _byte(content, position)
        if not header:
            return fields, position
        kind = header & 15
        step = header >> 4
        if step:
            last += step
        else:
            last, position = _signed(content, position)
        fields[last], position = _field(content, position, kind, depth)


def _field(content: Content, position: int, kind: int, depth: int) -> tuple[tuple[int, Any], int]:
    if kind in (TRUE, FALSE):
        return (kind, kind == TRUE), position
    value, position = _value(content, position, kind, depth)
    return (kind, value), position


def _value(content: Content, position: int, kind: int, depth: int) -> tuple[Any, int]:
    """Read one value of type `kind`."""
    if depth > DEEPEST:
        raise ValueError("nested too deeply")
    if kind in (TRUE, FALSE, BYTE):
        return _byte(content, position)
    if kind in (I16, I32, I64):
        return _signed(content, position)
    if kind == DOUBLE:
        return struct.unpack_from("<d", _slice(content, position, 8))[0], position + 8
    if kind == BINARY:
        length, position = _unsigned(content, position)
        return _slice(content, position, length), position + length
    if kind in (LIST, SET):
        header, position = _byte(content, position)
        count = header >> 4
        element = header & 15
        if count == 15:
            count, position = _unsigned(content, position)
        if count > len(content):
            raise ValueError("a list longer than the file")
        values = []
        for _ in range(count):
            value, position = _value(content, position, element, depth + 1)
            values.append(value)
        return (element, values), position
    if kind == STRUCT:
        return read_struct(content, position, depth + 1)
    raise ValueError(f"type {kind}")


def _byte(content: Content, position: int) -> tuple[int, int]:
    if not 0 <= position < len(content):
        raise ValueError("cut off")
    return content[position], position + 1


def _slice(content: Content, position: int, length: int) -> bytes:
    if position + length > len(content):
        raise ValueError("cut off")
    return bytes(content[position : position + length])


def _unsigned(content: Content, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        part, position = _byte(content, position)
        value |= (part & 127) << shift
        if part < 128:
            return value, position
    raise ValueError("a number of more than 64 bits")


def _signed(content: Content, position: int) -> tuple[int, int]:
    value, position = _unsigned(content, position)
    return (value >> 1) ^ -(value & 1), position


def write_struct(fields: Fields) -> bytes:
    """Return the bytes of a struct."""
    parts = []
    last = 0
    for number in sorted(fields):
        kind, value = fields[number]
        step = number - last
        parts.append(
            bytes([step << 4 | kind]) if step < 16 else bytes([kind]) + _write_signed(number)
        )
        if kind not in (TRUE, FALSE):
            parts.append(_write(kind, value))
        last = number
    return b"".join(parts) + b"\0"


def _write(kind: int, value: Any) -> bytes:
    """Return the bytes of one value."""
    if kind in (TRUE, FALSE, BYTE):
        return bytes([value])
    if kind in (I16, I32, I64):
        return _write_signed(value)
    if kind == DOUBLE:
        return struct.pack("<d", value)
    if kind == BINARY:
        content: bytes = value
        return _write_unsigned(len(content)) + content
    if kind == STRUCT:
        return write_struct(value)
    element, values = value
    if len(values) < 15:
        header = bytes([len(values) << 4 | element])
    else:
        header = bytes([15 << 4 | element]) + _write_unsigned(len(values))
    return header + b"".join(_write(element, item) for item in values)


def _write_unsigned(value: int) -> bytes:
    parts = bytearray()
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def _write_signed(value: int) -> bytes:
    return _write_unsigned(value << 1 ^ value >> 63)
