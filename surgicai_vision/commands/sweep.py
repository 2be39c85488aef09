"""`sweep`: encode, train and evaluate every cell of a grid."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import option, positive, read_yaml
from surgicai_vision.config import from_mapping
from surgicai_vision.errors import BadFile, UnknownName
from surgicai_vision.files import configs_folder
from surgicai_vision.sweep import Grid

EXAMPLE = "surgicai-vision sweep configs/sweep/smoke.yaml --out outputs/sweeps/smoke --json"


@dataclass(frozen=True)
class Options:
    """Options of `sweep`."""

    grid: str = option(dataclasses.MISSING, "the grid; shipped ones also by their name (smoke)", metavar="GRID.yaml")
    out: str | None = option(
        None, "folder to make or to continue", metavar="DIR", default_text="outputs/sweeps/<name of the grid>"
    )
    dry_run: bool = option(False, "list the cells and do no work")
    workers: int = option(folders.CORES, "processes", check=positive, metavar="N")


def run(options: Options, console: Console) -> dict[str, Any]:
    """Run the sweep, or list its cells."""
    from surgicai_vision.sweep import plan, run_sweep

    path = grid_file(options.grid)
    grid = read_grid(path)
    out = Path(options.out) if options.out else folders.OUTPUTS / "sweeps" / path.stem
    if options.dry_run:
        states = plan(grid, out)
        for state in states:
            line = f"{state.state:<8} {state.key}  {state.cell.task}, {state.cell.name}, seed {state.cell.seed}"
            console.say(f"{line}: {state.reason}" if state.reason else line)
        known = ("to do", "cached", "not run")
        counts = {name.replace(" ", "_"): sum(state.state == name for state in states) for name in known}
        return {"cells": len(states), **counts, "dry_run": True}
    result = run_sweep(grid, out, console.stage, options.workers)
    for line in result.pop("problems"):
        console.say(line)
    told = ", ".join(f"{result[name]} {name.replace('_', ' ')}" for name in ("done", "cached", "failed", "not_run"))
    console.say(f"{result['cells']} cells: {told}; {out}")
    return {**result, "exit_code": 1 if result["failed"] else 0}


def grid_file(given: str) -> Path:
    """Find a grid: a file, or the name or repository path of a shipped one."""
    path, folder = Path(given), configs_folder() / "sweep"
    if path.exists():
        return path
    shipped = {file.stem: file for file in folder.glob("*.yaml")}
    if given in (path.stem, f"configs/sweep/{path.name}") and path.stem in shipped:
        return shipped[path.stem]
    if path.suffix or path.parent != Path():
        raise BadFile(f"There is no grid {path}; shipped ones: {', '.join(sorted(shipped))}.")
    raise UnknownName("grid", given, shipped)


def read_grid(path: Path) -> Grid:
    """Read a grid; a view set may be written as a list or as "front,back"."""
    table = read_yaml(path)
    if isinstance(table.get("view"), list):
        table["view"] = [view.split(",") if isinstance(view, str) else view for view in table["view"]]
    for name in ("task", "encoder", "view"):
        table.setdefault(name, [])
    return from_mapping(Grid, table, str(path))
