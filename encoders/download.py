"""Download one weights file: resumable, and accepted only if its hash is right.

`fetch(source, revision, filename, sha256, folder) -> Path`. The hub's own client restarts a file
from scratch after a killed process. The bytes are therefore fetched here by HTTP ranges, into
`<filename>.<identity>.partial`, which is renamed when complete.
"""

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from surgicai_vision.core.errors import BadFile, SurgicaiError
from surgicai_vision.core.files import locked, sha256_file

TIMEOUT = 20.0  # without a byte [s]
FULL_REVISION = re.compile(r"[0-9a-f]{40}")
"""The hub resolves whole commit hashes and branches, no abbreviated hash."""


class BrokenOff(SurgicaiError):
    """A download that ended before the file was whole; what has come is kept."""


def fetch(source: str, revision: str, filename: str, sha256: str | None, folder: Path) -> Path:
    """Return the file of a hub repository, downloaded into `folder` unless it is there.

    Args:
        source: the repository, "owner/name".
        revision: commit; anything but a whole hash means the branch main.
        filename: the file in it.
        sha256: what the file must have; None takes what the hub says of it.
        folder: where it is kept.

    Raises:
        BrokenOff: the transfer ended early; calling again goes on.
        BadFile: what came has another hash; it is deleted.
        Exception: whatever the network raised before the first byte.
    """
    target = folder / filename
    if target.is_file():
        return target
    from huggingface_hub import constants, get_hf_file_metadata

    at = revision if FULL_REVISION.fullmatch(revision) else "main"
    url = f"{constants.ENDPOINT}/{source}/resolve/{at}/{filename}"
    about = get_hf_file_metadata(url, timeout=TIMEOUT)
    identity = about.etag or "unknown"
    wanted = sha256 or (identity if len(identity) == 64 else None)
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f"{filename}.{re.sub(r'[^0-9a-zA-Z]', '', identity)[:64]}.partial"
    with locked(folder / f".{filename}.lock"), open(partial, "ab") as file:
        if target.is_file():
            return target
        _complete(url, file, about.size, filename)
        file.flush()
        os.fsync(file.fileno())
        actual = sha256_file(partial)
        if wanted and not actual.startswith(wanted):
            partial.unlink()
            raise BadFile(
                f"The file from {url} has sha256 {actual}, expected {wanted}; it was deleted. "
                "Try again later."
            )
        os.replace(partial, target)
    return target


def _complete(url: str, file: BinaryIO, size: int | None, name: str) -> None:
    """Append to `file` until it has `size` bytes; each attempt must bring some."""
    with _bar(name, size) as show:
        while size is None or file.tell() < size:
            before = file.tell()
            problem = "the server closed the connection"
            try:
                _append(url, file, show)
            except Exception as error:  # whatever the network did: the bytes received are kept
                problem = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
            if size is None and problem.startswith("the server"):
                return
            if file.tell() == before:
                raise BrokenOff(
                    f"the download of {url} stopped after {before} of {size} bytes ({problem})"
                )
    if file.tell() != size:
        file.truncate(0)
        raise BrokenOff(f"{url} sent more than the {size} bytes it announced")


def _append(url: str, file: BinaryIO, show: Callable[[int], None]) -> None:
    """Append what is missing, or all of it where the server knows no ranges."""
    from huggingface_hub.utils import get_session

    start = file.tell()
    headers = {"Range": f"bytes={start}-", "Accept-Encoding": "identity"}
    with get_session().stream(
        "GET", url, headers=headers, timeout=TIMEOUT, follow_redirects=True
    ) as answer:
        answer.raise_for_status()
        if answer.status_code != 206:
            file.truncate(0)
            file.seek(0)
        try:
            for piece in answer.iter_raw():
                file.write(piece)
                show(file.tell())
        finally:
            file.flush()


@contextmanager
def _bar(name: str, size: int | None) -> Iterator[Callable[[int], None]]:
    """Show the bytes that have come on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    columns = (
        TextColumn("{task.description:<38}"),
        BarColumn(bar_width=20),
        DownloadColumn(),
        TransferSpeedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=4) as bars:
        bar = bars.add_task(f"downloading {name}", total=size)
        yield lambda done: bars.update(bar, completed=done)
