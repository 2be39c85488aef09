"""Sweep: a grid of cells; each is encode (cached) → train → evaluate, and is done once.

`out` holds `sweep.json` (the grid), `data/<task>/` (demonstrations and dataset), `cells/<key>/` with
`policy/`, `evaluation/` and `cell.json` (written last), `references/` (expert, replay), `episodes.parquet` (one
row an episode) and `run.json` for the report. The key is the digest of everything a cell is, so running
again does only what is missing; a cell that failed is tried again, one whose weights cannot be had is
reported as not run, with the reason.
"""

import functools
import itertools
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision import files, names, registry
from surgicai_vision.cells import (
    Cell,
    Stage,
    baseline_subject,
    checkpoint_subject,
    evaluate_once,
    prepare_dataset,
    replay_subject,
    train_cell,
)  # fmt: skip
from surgicai_vision.config import TaskConfig, digest, to_mapping
from surgicai_vision.errors import InputError, MissingWeights, OutputExists, SurgicaiError
from surgicai_vision.provenance import command_line, provenance
from surgicai_vision.report import RUN_FILE
from surgicai_vision.results import parquet_bytes, read_rows

GRID_FILE, CELL_FILE, EPISODES = "sweep.json", "cell.json", "episodes.parquet"


@dataclass(frozen=True)
class Grid:
    """A sweep's configuration: every combination of task × encoder × view × seed, and what they share.

    Attributes:
        task: tasks.
        encoder: encoders.
        view: view sets, each a list of views.
        seed: training seeds.
        policy: policy of every cell.
        recipe: its recipe.
        pool: what is taken from the encoders.
        deviation: sets of `config.Deviations` switches to be on, an axis of its own; none takes the recipe's.
        accept_licence: accept weights under a non-commercial licence.
        proprioception: add a cell without pictures for each task and seed.
        state: add a cell that sees the state with the goal, the ceiling, for each task and seed.
        expert: evaluate the expert on each task beside the cells.
        replay: evaluate blind replay of the mean demonstration too.
        demonstrations: expert demonstrations of each task.
        episodes: held-out starts of each evaluation.
        size: height and width of pictures [px].
        depth: render depth beside RGB.
    """

    task: tuple[str, ...]
    encoder: tuple[str, ...]
    view: tuple[tuple[str, ...], ...]
    seed: tuple[int, ...] = (0,)
    policy: str = "bc"
    recipe: str = "paper"
    pool: str = "global"
    deviation: tuple[tuple[str, ...], ...] = ()
    accept_licence: bool = False
    proprioception: bool = False
    state: bool = False
    expert: bool = True
    replay: bool = False
    demonstrations: int = 50
    episodes: int = 20
    size: int = 224
    depth: bool = False

    def __post_init__(self) -> None:
        for name in self.encoder:
            registry.check_encoder_name(name)
        for name in ("demonstrations", "episodes", "size"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least 1.")
        if not self.cells or len(set(self.cells)) != len(self.cells):
            raise InputError(f"The grid has {len(self.cells)} cells, {len(set(self.cells))} of them different.")

    @property
    def cells(self) -> list[Cell]:
        """The cells, in the order of the grid."""
        common: dict[str, Any] = {"policy": self.policy, "recipe": self.recipe}
        cells = []
        for task, seed in itertools.product(self.task, self.seed):
            for encoder, view, switches in itertools.product(self.encoder, self.view, self.deviation or (None,)):
                cells.append(Cell(task, encoder, view, seed, pool=self.pool, deviations=switches, **common))
            cells += [Cell(task, None, (), seed, **common)] if self.proprioception else []
            cells += [Cell(task, None, (), seed, privileged=True, **common)] if self.state else []
        return cells

    @property
    def views(self) -> tuple[str, ...]:
        """Every view some cell needs."""
        return tuple(view for view in names.CAMERAS if any(view in view_set for view_set in self.view))

    def key(self, cell: Cell) -> str:
        """Return the digest of everything that decides a cell's result."""
        shared = {name: getattr(self, name) for name in ("demonstrations", "episodes", "size", "depth")}
        return digest({"cell": to_mapping(cell), "views": list(self.views), **shared})[:16]


@dataclass(frozen=True)
class CellState:
    """A cell and what is known of it: "cached", "to do" or "not run" with the reason."""

    cell: Cell
    key: str
    state: str
    reason: str = ""


def plan(grid: Grid, out: Path) -> list[CellState]:
    """Return every cell of `grid` with its state in the folder `out`; does no work."""
    states = []
    for cell in grid.cells:
        key = grid.key(cell)
        if (out / "cells" / key / CELL_FILE).exists():
            states.append(CellState(cell, key, "cached"))
            continue
        try:
            if cell.encoder:
                registry.find_weights(cell.encoder, accept_licence=grid.accept_licence)
            states.append(CellState(cell, key, "to do"))
        except MissingWeights as error:
            states.append(CellState(cell, key, "not run", str(error)))
    return states


def run_sweep(grid: Grid, out: Path, stage: Stage, workers: int) -> dict[str, Any]:
    """Run every cell that is not done and can be run.

    Returns:
        {"cells", "done" (by this call), "cached", "failed", "not_run", "digest" (of all rows there are),
        "problems": one line for each cell that failed or was not run}.

    Raises:
        OutputExists: `out` holds something else.
    """
    _open(grid, out)
    counts = {"cells": 0, "done": 0, "cached": 0, "failed": 0, "not_run": 0}
    problems = []
    for state in plan(grid, out):
        counts["cells"] += 1
        where = f"{state.cell.task}, {state.cell.name}, seed {state.cell.seed}"
        if state.state == "not run":
            counts["not_run"] += 1
            problems.append(f"not run: {where}: {state.reason}")
        elif state.state == "cached":
            counts["cached"] += 1
        else:
            error = _run_cell(grid, state, out, stage, workers)
            counts["failed" if error else "done"] += 1
            problems += [f"failed: {where}: {error}"] if error else []
    if grid.expert:
        for task in grid.task:
            _run_expert(grid, task, out, stage, workers)
    if grid.replay:
        for task in grid.task:
            make = functools.partial(replay_subject, _dataset(grid, task, out, stage, workers))
            evaluate_once(out / "references" / f"replay-{task}", make, _seeds(grid), stage, workers)
    table = _collect(grid, out)
    _store_run(grid, out, problems)
    return {**counts, "digest": digest(table), "problems": problems, "out": str(out)}


def _open(grid: Grid, out: Path) -> None:
    """Make the folder, or accept the one of the same grid."""
    files.check_output(out, may_resume=GRID_FILE)
    if (out / GRID_FILE).exists():
        if files.read_json(out / GRID_FILE) != to_mapping(grid):
            raise OutputExists(f"--out {out} holds another sweep (see {out / GRID_FILE}); give another folder.")
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out} cannot be written: {error.strerror}; choose another folder.") from None
    files.write_json(out / GRID_FILE, to_mapping(grid))


def _seeds(grid: Grid) -> Sequence[int]:
    return range(names.TEST_SEED, names.TEST_SEED + grid.episodes)


def _run_cell(grid: Grid, state: CellState, out: Path, stage: Stage, workers: int) -> str:
    """Run one cell; return "" or what went wrong, in one line."""
    folder = out / "cells" / state.key
    folder.mkdir(parents=True, exist_ok=True)
    try:
        dataset = _dataset(grid, state.cell.task, out, stage, workers)
        train_cell(state.cell, dataset, folder / "policy", stage, accept_licence=grid.accept_licence)
        make = functools.partial(checkpoint_subject, folder / "policy", accept_licence=grid.accept_licence)
        summary = evaluate_once(folder / "evaluation", make, _seeds(grid), stage, workers)
    except Exception as error:  # one broken cell must not end the sweep; its error is kept and reported
        details = str(error) if isinstance(error, SurgicaiError) else traceback.format_exc()
        files.write_json(folder / "failed.json", {"cell": to_mapping(state.cell), "error": details})
        return " ".join(str(error).split()) or type(error).__name__
    (folder / "failed.json").unlink(missing_ok=True)
    files.write_json(folder / CELL_FILE, {"cell": to_mapping(state.cell), "summary": summary})
    return ""


def _dataset(grid: Grid, task: str, out: Path, stage: Stage, workers: int) -> Any:
    """Return the task's dataset, made where it is missing."""
    from surgicai_vision.dataset import open_dataset

    folder = out / "data" / task
    views = grid.views or ("front",)
    if not (folder / "dataset" / names.META_FILE).exists():
        prepare_dataset(
            TaskConfig(task), folder, stage, demonstrations=grid.demonstrations, views=views, size=grid.size,
            depth=grid.depth, workers=workers,
        )  # fmt: skip
    return open_dataset(folder / "dataset")


def _run_expert(grid: Grid, task: str, out: Path, stage: Stage, workers: int) -> None:
    make = functools.partial(baseline_subject, "expert", TaskConfig(task))
    evaluate_once(out / "references" / f"expert-{task}", make, _seeds(grid), stage, workers)


def _collect(grid: Grid, out: Path) -> list[dict[str, Any]]:
    """Write `episodes.parquet` of all cells that are done and return its rows."""
    table = []
    for cell in grid.cells:
        key = grid.key(cell)
        if (out / "cells" / key / CELL_FILE).exists():
            about = {"cell": key, "encoder": cell.encoder, "view": "+".join(cell.view), "training_seed": cell.seed}
            table += [{**about, **row} for row in read_rows(out / "cells" / key / "evaluation")]
    files.write_bytes(out / EPISODES, parquet_bytes(table))
    return table


def _store_run(grid: Grid, out: Path, problems: list[str]) -> None:
    """Write what the report says of the run; only when something changed."""
    old = files.read_json(out / RUN_FILE) if (out / RUN_FILE).exists() else {}
    data = (
        f"{grid.demonstrations} demonstrations of each task by the scripted expert; {', '.join(grid.views)} at "
        f"{grid.size} × {grid.size}; {grid.policy}, recipe '{grid.recipe}'"
    )
    run = {"title": "sweep", "command": old.get("command") or command_line(), "data": data, "not_run": problems}
    files.write_json(out / RUN_FILE, {**run, "provenance": old.get("provenance") or provenance()})
