"""Read a parquet file whose writer was killed before it wrote the footer.

    groups = recover(Path("file-000.parquet"), sample, Path("mended.parquet"))

The row groups of such a file are whole: pyarrow writes each one when it is closed, and only the
table of their positions is missing. That table is rebuilt by walking the pages' own headers; the
schema gives the number of values per row in each column. It is written after the row groups. An
incomplete last row group is dropped. The result is not trusted: the caller reads and verifies every
row.
"""

import io
import itertools
import mmap
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple, cast

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_salvage import thrift
from lerobot_salvage.thrift import Content, Fields, read_struct, write_struct
from surgicai_vision.dataset.lerobot_files import LeRobotFiles
from surgicai_vision.dataset.writer import compression

MAGIC = b"PAR1"


class PageType(IntEnum):
    """PageHeader.type (parquet.thrift, parquet-format 2.9)."""

    DATA = 0
    DICTIONARY = 2
    DATA_V2 = 3


VALUE_COUNTS = {PageType.DATA: 5, PageType.DICTIONARY: 7, PageType.DATA_V2: 8}
"""Page type → the field of PageHeader whose first field is the number of values."""


class File(IntEnum):
    """Fields of FileMetaData (parquet.thrift)."""

    ROWS = 3
    GROUPS = 4


class Group(IntEnum):
    """Fields of RowGroup (parquet.thrift)."""

    COLUMNS = 1
    BYTES = 2
    ROWS = 3
    OFFSET = 5
    COMPRESSED = 6
    ORDINAL = 7


class Chunk(IntEnum):
    """Fields of ColumnChunk (parquet.thrift)."""

    OFFSET = 2
    META = 3


class Meta(IntEnum):
    """Fields of ColumnMetaData (parquet.thrift)."""

    VALUES = 5
    UNCOMPRESSED = 6
    COMPRESSED = 7
    DATA_OFFSET = 9
    DICTIONARY_OFFSET = 11


HINTS = (8, 10, 12, 13, 14, 15, 16, 17)
"""Fields of ColumnMetaData that no reader needs."""


@dataclass(frozen=True)
class Writing:
    """How a file was written.

    Attributes:
        compression: codec of all columns, or column → codec.
        dictionary: whether values were put into dictionaries.
    """

    compression: str | Mapping[str, str]
    dictionary: bool


LEROBOT = Writing("snappy", True)
"""How LeRobot's writer writes (lerobot 0.6.1, datasets/dataset_writer.py)."""


class _Page(NamedTuple):
    """A page: its start and end, type, number of values and decompressed size in bytes."""

    start: int
    end: int
    kind: int
    values: int
    size: int


class _Column(NamedTuple):
    """A column of a row group: its consecutive pages."""

    pages: list[_Page]

    @property
    def values(self) -> int:
        return sum(page.values for page in self.pages if page.kind != PageType.DICTIONARY)


def recover(path: Path, sample: pa.Table, to: Path, writing: Writing = LEROBOT) -> int:
    """Write the whole row groups of a footerless file as a parquet file; return their number.

    Args:
        path: the broken file.
        sample: one row in the schema the file was written with; its lists have full length.
        to: the file to write; not written if nothing can be kept.
        writing: how the broken file was written.
    """
    buffer = io.BytesIO()
    pq.write_table(
        sample,
        buffer,
        compression=writing.compression,
        use_dictionary=writing.dictionary,
    )
    footer = _footer(buffer.getvalue())
    (model,) = footer[File.GROUPS][1][1]
    leaves = [chunk[Chunk.META][1] for chunk in model[Group.COLUMNS][1][1]]
    if path.stat().st_size < len(MAGIC):
        return 0
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[: len(MAGIC)] != MAGIC:
            return 0
        groups = list(_groups(content, leaves))
    if not groups:
        return 0
    rows = [chunks[0].values // leaves[0][Meta.VALUES][1] for chunks in groups]
    tables = [
        _group(model, chunks, count, number)
        for number, (chunks, count) in enumerate(zip(groups, rows, strict=True))
    ]
    footer[File.ROWS] = (thrift.I64, sum(rows))
    footer[File.GROUPS] = (thrift.LIST, (thrift.STRUCT, tables))
    end = groups[-1][-1].pages[-1].end
    tail = write_struct(footer)
    with open(path, "rb") as source, open(to, "wb") as target:
        shutil.copyfileobj(source, target)
        target.truncate(end)
        target.seek(end)
        target.write(tail + len(tail).to_bytes(4, "little") + MAGIC)
    return len(groups)


def open_or_recover(file: Path, files: LeRobotFiles, scratch: Path) -> pq.ParquetFile:
    """Open a data file of a dataset, or a copy of its recoverable part, written into `scratch`.

    Raises:
        ValueError: no row group can be recovered.
    """
    try:
        return pq.ParquetFile(file)
    except (OSError, pa.ArrowException):
        name = file.relative_to(files.path)
        files.problems.append(f"{name} has no footer: its writer was killed.")
    mended = scratch / "-".join(name.parts)
    depth = [
        key for key, row in files.features.items() if (row.get("info") or {}).get("is_depth_map")
    ]
    for writing in (LEROBOT, Writing(compression(files.schema, depth), False)):
        if recover(file, _sample(files), mended, writing):
            return pq.ParquetFile(mended)
    raise ValueError("no complete row group in it")


def _sample(files: LeRobotFiles) -> pa.Table:
    """Return a table with one row in the schema of a dataset's data files."""
    columns = {}
    for field in files.schema:
        shape = files.features.get(field.name, {"shape": (1,)})["shape"]
        columns[field.name] = pa.array([_example(field.type, shape)], field.type)
    return pa.table(columns, schema=files.schema)


def _example(kind: pa.DataType, shape: tuple[int, ...]) -> object:
    """Return a value of an Arrow type; lists have the feature's shape."""
    if pa.types.is_struct(kind):
        return {"bytes": b"x", "path": "x"}
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return [_example(kind.value_type, shape[1:])] * shape[0]
    if pa.types.is_string(kind):
        return "x"
    return pa.types.is_boolean(kind) or 0


def _footer(content: bytes) -> Fields:
    """Return the FileMetaData of a complete parquet file."""
    length = int.from_bytes(content[-8:-4], "little")
    return read_struct(content, len(content) - 8 - length)[0]


def _groups(content: Content, leaves: list[Fields]) -> Iterator[list[_Column]]:
    """Yield the whole row groups from the beginning of the file, each as a list of columns."""
    position = len(MAGIC)
    while True:
        group = _next_group(content, position, leaves)
        if group is None:
            return
        yield group
        position = group[-1].pages[-1].end


def _next_group(content: Content, position: int, leaves: list[Fields]) -> list[_Column] | None:
    """Return the row group at `position`, or None if there is no whole one.

    The number of rows and the end of the first column are not recorded. So the first column is
    tried with one page, with two, …, until all other columns have the same number of rows.
    """
    first: list[_Page] = []
    for page in _pages(content, position):
        if page.kind == PageType.DICTIONARY and first:
            return None
        first.append(page)
        chunk = _Column(list(first))
        rows, odd = divmod(chunk.values, leaves[0][Meta.VALUES][1])
        if not rows or odd:
            continue
        others = _others(content, page.end, leaves[1:], rows)
        if others is not None:
            return [chunk, *others]
    return None


def _others(
    content: Content, position: int, leaves: list[Fields], rows: int
) -> list[_Column] | None:
    """Return a row group's columns after the first, or None if they do not have `rows` rows."""
    chunks = []
    for leaf in leaves:
        chunk = _chunk(content, position, leaf, rows * leaf[Meta.VALUES][1])
        if chunk is None:
            return None
        chunks.append(chunk)
        position = chunk.pages[-1].end
    return chunks


def _chunk(content: Content, position: int, leaf: Fields, values: int) -> _Column | None:
    """Return the column of `values` values at `position`, or None if there is none."""
    pages: list[_Page] = []
    left = values
    for page in _pages(content, position):
        begins = not pages
        if (page.kind == PageType.DICTIONARY) != (begins and Meta.DICTIONARY_OFFSET in leaf):
            return None
        pages.append(page)
        left -= page.values if page.kind != PageType.DICTIONARY else 0
        if left <= 0:
            return _Column(pages) if not left else None
    return None


def _pages(content: Content, position: int) -> Iterator[_Page]:
    """Yield the pages from `position` on, as long as they are complete."""
    for _ in itertools.count():
        try:
            header, body = read_struct(content, position)
            kind, size, stored = (_number(header, field) for field in (1, 2, 3))
            values = _number(header[VALUE_COUNTS[PageType(kind)]][1], 1)
        except (ValueError, KeyError, TypeError, IndexError):
            return
        if min(size, stored, values) < 0 or body + stored > len(content):
            return
        yield _Page(position, body + stored, kind, values, size + body - position)
        position = body + stored


def _number(fields: Fields, field: int) -> int:
    """Return a field of a page's header; all that are read are 32-bit numbers.

    A complete footer, which can follow the last page, has other types in these fields.
    """
    kind, value = fields[field]
    if kind != thrift.I32:
        raise ValueError(f"type {kind}")
    return cast(int, value)


def _group(model: Fields, chunks: list[_Column], rows: int, number: int) -> Fields:
    """Return the footer's RowGroup for `chunks`, modelled on that of the sample."""
    tables = []
    for example, chunk in zip(model[Group.COLUMNS][1][1], chunks, strict=True):
        meta = {key: value for key, value in example[Chunk.META][1].items() if key not in HINTS}
        pages = chunk.pages
        data = next(page for page in pages if page.kind != PageType.DICTIONARY)
        meta[Meta.VALUES] = (thrift.I64, chunk.values)
        meta[Meta.UNCOMPRESSED] = (thrift.I64, sum(page.size for page in pages))
        meta[Meta.COMPRESSED] = (thrift.I64, pages[-1].end - pages[0].start)
        meta[Meta.DATA_OFFSET] = (thrift.I64, data.start)
        meta.pop(Meta.DICTIONARY_OFFSET, None)
        if pages[0].kind == PageType.DICTIONARY:
            meta[Meta.DICTIONARY_OFFSET] = (thrift.I64, pages[0].start)
        tables.append(
            {Chunk.OFFSET: (thrift.I64, pages[0].start), Chunk.META: (thrift.STRUCT, meta)}
        )
    return {
        Group.COLUMNS: (thrift.LIST, (thrift.STRUCT, tables)),
        Group.BYTES: (thrift.I64, sum(page.size for chunk in chunks for page in chunk.pages)),
        Group.ROWS: (thrift.I64, rows),
        Group.OFFSET: (thrift.I64, chunks[0].pages[0].start),
        Group.COMPRESSED: (thrift.I64, chunks[-1].pages[-1].end - chunks[0].pages[0].start),
        Group.ORDINAL: (thrift.I16, number),
    }
