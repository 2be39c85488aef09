"""Read a parquet file whose writer was killed before it wrote the footer.

    groups = recover(Path("data/chunk-000/file-000.parquet"), sample, Path("mended.parquet"))

The row groups of such a file are whole: pyarrow writes each as it is closed, and only the table of
where they lie is missing. That table is rebuilt by walking the pages' own headers, with the schema
as the guide to how many values each column has, and written behind the row groups. A last row group
that is not whole is left out. What comes back is not trusted: the caller reads and verifies every
row of it.
"""

import io
import itertools
import mmap
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_salvage import thrift
from lerobot_salvage.thrift import Fields, read_struct, write_struct
from surgicai_vision.dataset.lerobot_files import LeRobotFiles
from surgicai_vision.dataset.writer import compression

MAGIC = b"PAR1"
DATA_PAGE, DICTIONARY_PAGE, DATA_PAGE_V2 = 0, 2, 3
"""PageHeader.type (parquet.thrift, parquet-format 2.9)."""

SCHEMA, ROWS, GROUPS = 2, 3, 4
COLUMNS, GROUP_BYTES, GROUP_ROWS, GROUP_OFFSET, GROUP_COMPRESSED, ORDINAL = 1, 2, 3, 5, 6, 7
CHUNK_OFFSET, CHUNK_META = 2, 3
VALUES, UNCOMPRESSED, COMPRESSED, DATA_OFFSET, DICTIONARY_OFFSET = 5, 6, 7, 9, 11
OPTIONAL_META = (8, 10, 12, 13, 14, 15, 16, 17)
"""Field numbers of FileMetaData, RowGroup, ColumnChunk and ColumnMetaData; the last are hints
nobody needs.
"""


@dataclass(frozen=True)
class Writing:
    """How a file was written: codec by column (or of all) and whether values were put into
    dictionaries.
    """

    compression: str | Mapping[str, str]
    dictionary: bool


LEROBOT = Writing("snappy", True)
"""As LeRobot's writer does (lerobot 0.6.1, datasets/dataset_writer.py)."""


class _Page(NamedTuple):
    """A page: where it begins and ends, its kind, its number of values, its bytes when
    decompressed.
    """

    start: int
    end: int
    kind: int
    values: int
    size: int


class _Chunk(NamedTuple):
    """A column of a row group: its pages, one behind the other."""

    pages: list[_Page]

    @property
    def values(self) -> int:
        return sum(page.values for page in self.pages if page.kind != DICTIONARY_PAGE)


def recover(path: Path, sample: pa.Table, to: Path, writing: Writing = LEROBOT) -> int:
    """Write the whole row groups of the footerless file `path` as the parquet file `to`; return
    their number.

    Args:
        path: the broken file.
        sample: one row of the schema it was written with, its lists of their full lengths.
        to: the file to write; it is not written when nothing can be kept.
        writing: how it was written.
    """
    buffer = io.BytesIO()
    pq.write_table(
        sample,
        buffer,
        compression=writing.compression,  # type: ignore[arg-type]
        use_dictionary=writing.dictionary,
    )
    footer = _footer(buffer.getvalue())
    (model,) = footer[GROUPS][1][1]
    leaves = [chunk[CHUNK_META][1] for chunk in model[COLUMNS][1][1]]
    if path.stat().st_size < len(MAGIC):
        return 0
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[: len(MAGIC)] != MAGIC:
            return 0
        groups = list(_groups(content, leaves))
    if not groups:
        return 0
    rows = [chunks[0].values // leaves[0][VALUES][1] for chunks in groups]
    tables = [
        _group(model, chunks, count, number)
        for number, (chunks, count) in enumerate(zip(groups, rows, strict=True))
    ]
    footer[ROWS] = (thrift.I64, sum(rows))
    footer[GROUPS] = (thrift.LIST, (thrift.STRUCT, tables))
    end, tail = groups[-1][-1].pages[-1].end, write_struct(footer)
    with open(path, "rb") as source, open(to, "wb") as target:
        shutil.copyfileobj(source, target)
        target.truncate(end)
        target.seek(end)
        target.write(tail + len(tail).to_bytes(4, "little") + MAGIC)
    return len(groups)


def open_or_recover(file: Path, files: LeRobotFiles, scratch: Path) -> pq.ParquetFile:
    """Open a data file of a dataset, or what can be recovered of it, written into `scratch`.

    Raises:
        ValueError: not one row group can be recovered.
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
    raise ValueError("no whole row group in it")


def _sample(files: LeRobotFiles) -> pa.Table:
    """Return a table of one row in the schema of a dataset's data files."""
    columns = {}
    for field in files.schema:
        shape = files.features.get(field.name, {"shape": (1,)})["shape"]
        columns[field.name] = pa.array([_example(field.type, shape)], field.type)
    return pa.table(columns, schema=files.schema)


def _example(kind: pa.DataType, shape: tuple[int, ...]) -> object:
    """Return a value of an Arrow type, lists of the feature's length."""
    if pa.types.is_struct(kind):
        return {"bytes": b"x", "path": "x"}
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return [_example(kind.value_type, shape[1:])] * shape[0]
    if pa.types.is_string(kind):
        return "x"
    return pa.types.is_boolean(kind) or 0


def _footer(content: bytes) -> Fields:
    """Return the FileMetaData of a whole parquet file."""
    length = int.from_bytes(content[-8:-4], "little")
    return read_struct(content, len(content) - 8 - length)[0]


def _groups(content: Any, leaves: list[Fields]) -> Iterator[list[_Chunk]]:
    """Yield the whole row groups from the beginning of the file, each as its columns."""
    position = len(MAGIC)
    while True:
        group = _next_group(content, position, leaves)
        if group is None:
            return
        yield group
        position = group[-1].pages[-1].end


def _next_group(content: Any, position: int, leaves: list[Fields]) -> list[_Chunk] | None:
    """Return the row group at `position`, or None where there is no whole one.

    Nothing says how many rows it has or where its first column ends; so the first column is taken
    with one page, with two, …, until every other column comes to the same number of rows.
    """
    first: list[_Page] = []
    for page in _pages(content, position):
        if page.kind == DICTIONARY_PAGE and first:
            return None
        first.append(page)
        chunk = _Chunk(list(first))
        rows, odd = divmod(chunk.values, leaves[0][VALUES][1])
        if not rows or odd:
            continue
        others = _others(content, page.end, leaves[1:], rows)
        if others is not None:
            return [chunk, *others]
    return None


def _others(content: Any, position: int, leaves: list[Fields], rows: int) -> list[_Chunk] | None:
    """Return the columns behind the first one of a row group of `rows` rows, or None where they do
    not fit.
    """
    chunks = []
    for leaf in leaves:
        chunk = _chunk(content, position, leaf, rows * leaf[VALUES][1])
        if chunk is None:
            return None
        chunks.append(chunk)
        position = chunk.pages[-1].end
    return chunks


def _chunk(content: Any, position: int, leaf: Fields, values: int) -> _Chunk | None:
    """Return the column of `values` values at `position`, or None where there is none."""
    pages: list[_Page] = []
    left = values
    for page in _pages(content, position):
        begins = not pages
        if (page.kind == DICTIONARY_PAGE) != (begins and DICTIONARY_OFFSET in leaf):
            return None
        pages.append(page)
        left -= page.values if page.kind != DICTIONARY_PAGE else 0
        if left <= 0:
            return _Chunk(pages) if not left else None
    return None


def _pages(content: Any, position: int) -> Iterator[_Page]:
    """Yield the pages from `position` on, as long as they are whole."""
    for _ in itertools.count():
        try:
            header, body = read_struct(content, position)
            kind, size, stored = (header[number][1] for number in (1, 2, 3))
            values = header[{DATA_PAGE: 5, DICTIONARY_PAGE: 7, DATA_PAGE_V2: 8}[kind]][1][1][1]
        except (ValueError, KeyError, TypeError, IndexError):
            return
        if min(size, stored, values) < 0 or body + stored > len(content):
            return
        yield _Page(position, body + stored, kind, values, size + body - position)
        position = body + stored


def _group(model: Fields, chunks: list[_Chunk], rows: int, number: int) -> Fields:
    """Return the RowGroup of the footer for `chunks`, made like that of the sample."""
    tables = []
    for example, chunk in zip(model[COLUMNS][1][1], chunks, strict=True):
        meta = {
            key: value for key, value in example[CHUNK_META][1].items() if key not in OPTIONAL_META
        }
        pages = chunk.pages
        data = next(page for page in pages if page.kind != DICTIONARY_PAGE)
        meta[VALUES] = (thrift.I64, chunk.values)
        meta[UNCOMPRESSED] = (thrift.I64, sum(page.size for page in pages))
        meta[COMPRESSED] = (thrift.I64, pages[-1].end - pages[0].start)
        meta[DATA_OFFSET] = (thrift.I64, data.start)
        meta.pop(DICTIONARY_OFFSET, None)
        if pages[0].kind == DICTIONARY_PAGE:
            meta[DICTIONARY_OFFSET] = (thrift.I64, pages[0].start)
        tables.append(
            {CHUNK_OFFSET: (thrift.I64, pages[0].start), CHUNK_META: (thrift.STRUCT, meta)}
        )
    return {
        COLUMNS: (thrift.LIST, (thrift.STRUCT, tables)),
        GROUP_BYTES: (thrift.I64, sum(page.size for chunk in chunks for page in chunk.pages)),
        GROUP_ROWS: (thrift.I64, rows),
        GROUP_OFFSET: (thrift.I64, chunks[0].pages[0].start),
        GROUP_COMPRESSED: (thrift.I64, chunks[-1].pages[-1].end - chunks[0].pages[0].start),
        ORDINAL: (thrift.I16, number),
    }
