"""The video that a page opens with, if its run has one.

A run names it in `run.json`: `"video": {"file", "poster", "strip", "title", "text"}`, with paths
inside the results folder. Small files are embedded, so that the page stays one file.
"""

import base64
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

EMBEDDED: Final = 5_000_000
"""Bytes up to which a file is embedded; a larger one is linked by its path."""
PARTS: Final = frozenset({"file", "poster", "strip", "title", "text"})
"""Keys of a run's video."""
KINDS: Final = {".mp4": "video/mp4", ".jpg": "image/jpeg"}


def opening_video(folder: Path, page: Path, run: Mapping[str, Any]) -> dict[str, str] | None:
    """Return what the template shows of a run's video; None if there is none.

    There is none either if a file is outside the results folder, or neither an MP4 nor a JPEG.

    Args:
        folder: the results.
        page: where the page is written.
        run: what `run.json` holds.
    """
    told = run.get("video")
    if not told or not told.keys() >= PARTS or not (folder / told["file"]).is_file():
        return None
    if not all(_is_shown(folder, told[key]) for key in ("file", "poster", "strip")):
        return None
    files = {key: _address(folder / told[key], page) for key in ("file", "poster", "strip")}
    return {**files, "title": told["title"], "text": told["text"]}


def _is_shown(folder: Path, name: str) -> bool:
    """Return True for a file inside the folder that a page can show, or that is not there."""
    path = (folder / name).resolve()
    inside = path.is_relative_to(folder.resolve())
    return inside and (path.suffix in KINDS or not path.is_file())


def _address(path: Path, page: Path) -> str:
    """Return a file as a data URI, or as its path relative to the page if it is large."""
    if not path.is_file():
        return ""
    if path.stat().st_size > EMBEDDED:
        return os.path.relpath(path.resolve(), page.resolve().parent)
    content = base64.b64encode(path.read_bytes()).decode()
    return f"data:{KINDS[path.suffix]};base64,{content}"
