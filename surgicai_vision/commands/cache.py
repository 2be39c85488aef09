"""`cache`: list, measure or prune the cache of frozen features."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import LIST
from surgicai_vision.core.errors import InputError

if TYPE_CHECKING:
    from surgicai_vision.features.cache import Manifest

app = App(name="cache", help_epilogue="example:\n  surgicai-vision cache list")
ACTIONS = ("list", "size", "prune")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `cache`.

    Attributes:
        action: What to do with the cached features.
        keep: With prune, folders of the datasets whose features are kept.
        all: With prune, delete every entry.
    """

    action: Annotated[str, Parameter(choices=ACTIONS, metavar="ACTION")] = field(kw_only=False)
    keep: Annotated[tuple[Path, ...], LIST, Parameter(metavar="DIR[,DIR]")] = ()
    all: bool = False


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Print the entries, or delete those of all datasets except the kept ones."""
    from surgicai_vision.features.cache import default_cache_root, list_cache, prune_cache

    prune = options.action == "prune"
    if not prune and (options.keep or options.all):
        raise InputError(
            f"--keep and --all say what prune deletes; '{options.action}' takes neither."
        )
    if prune and bool(options.keep) == options.all:
        raise InputError(
            f"prune deletes features in {default_cache_root()}; give either --keep DIR or --all."
        )
    if prune:
        kept = {folders.open_dataset(folder, None, ()).fingerprint for folder in options.keep}
        entries = prune_cache(keep_datasets=kept)
    else:
        entries = list_cache()
    if options.action != "size":
        for entry in entries:
            console.say(f"{entry.folder.name[:12]}  {_mb(entry.size):>10}  {_text(entry.manifest)}")
    total = sum(entry.size for entry in entries)
    said = "removed" if prune else "held"
    console.say(f"{len(entries)} entries, {_mb(total)} {said} in {default_cache_root()}")
    rows = [_row(entry.folder, entry.size, entry.manifest) for entry in entries]
    return {
        "action": options.action,
        "entries": rows,
        "bytes": total,
        "folder": str(default_cache_root()),
    }


def _mb(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


def _text(manifest: "Manifest | None") -> str:
    if manifest is None:
        return "unfinished or damaged"
    shape = " × ".join(map(str, (manifest["length"], *manifest["shape"])))
    dataset = f"dataset {manifest['dataset'][:12]}"
    return ", ".join((manifest["encoder"], manifest["view"], manifest["pool"], shape, dataset))


def _row(folder: Path, size: int, manifest: "Manifest | None") -> dict[str, object]:
    keys = ("dataset", "view", "encoder", "pool", "length", "dim")
    known: Mapping[str, object] = manifest or {}
    return {"key": folder.name, "bytes": size, **{key: known.get(key) for key in keys}}
