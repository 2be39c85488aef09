"""Running: what cells share is made first, each thing once; then the cells, side by side; then the
table.

A finished job is filed by one rename from `work/` to its place. A run that was killed in between
finds it in `work/`.
"""

import functools
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from surgicai_vision.core import files
from surgicai_vision.core.config import digest, to_mapping
from surgicai_vision.core.errors import InputError, OutputExists, SurgicaiError
from surgicai_vision.core.executor import Job, RunContext, claim, run
from surgicai_vision.evaluation.provenance import command_line, provenance
from surgicai_vision.evaluation.storage import (
    CELL_FILE,
    FAILED_FILE,
    GRID_FILE,
    RUN_FILE,
    parquet_bytes,
    read_rows,
)
from surgicai_vision.experiments.prepare import prepare_dataset
from surgicai_vision.experiments.run import Cell
from surgicai_vision.experiments.sweep.grid import Grid, chain_parts
from surgicai_vision.experiments.sweep.plan import (
    CACHED,
    LEFT,
    NOT_RUN,
    PROBE_FILE,
    REFERENCE_FILE,
    TO_DO,
    CellState,
    Jobs,
    plan,
)
from surgicai_vision.experiments.sweep.selection import EVERYTHING, Choice

EPISODES, PROBES = "episodes.parquet", "probes.parquet"
WORK = "work"
ATTEMPTS = 3
"""How often a cell is started whose worker dies."""


def run_sweep(
    grid: Grid,
    out: Path,
    context: RunContext,
    attempts: int = ATTEMPTS,
    choice: Choice = EVERYTHING,
) -> dict[str, Any]:
    """Run every cell that is not done and can be run.

    Args:
        grid: the cells.
        out: folder to make or to continue.
        context: workers, engine and display; the result does not depend on them.
        attempts: how often a cell is started whose worker dies.
        choice: the cells to work on; others that are not there yet are left for another call.

    Returns:
        {"cells", "done" (by this call), "cached", "failed", "not_run", "left", "digest" (of all
        rows there are), "problems": one line for each cell that failed or was not run}.

    Raises:
        InputError: `out` cannot be written, or another sweep is at work in it.
        OutputExists: `out` holds something else.
    """
    _open(grid, out)
    with claim(out / WORK):
        states = plan(grid, out, choice)
        tasks = [
            task
            for task in grid.task
            if any(s.cell.task == task and s.state != LEFT for s in states)
        ]
        do = functools.partial(run, context=context, attempts=attempts)
        sweep = _Sweep(grid, out, context, do, tuple(tasks))
        to_do = [state for state in states if state.state == TO_DO]
        sweep.prepare(to_do)
        sweep.do(to_do)
        here = [
            state
            for state in states
            if state.state in (CACHED, TO_DO) and state.key not in sweep.errors
        ]
        sweep.probe([state.cell for state in here])
        shutil.rmtree(out / WORK)
    skipped = [state for state in states if state.state == NOT_RUN]
    problems = [f"not run: {state.where}: {state.reason}" for state in skipped]
    problems += [
        f"failed: {state.where}: {sweep.errors[state.key]}"
        for state in to_do
        if state.key in sweep.errors
    ]
    problems += sweep.problems
    table = _collect(grid, out)
    _collect_probes(out)
    _store_run(grid, out, problems, skipped)
    counts = {
        "cells": len(states),
        "done": len(to_do) - len(sweep.errors),
        "cached": sum(state.state == CACHED for state in states),
        "failed": len(sweep.errors),
        "not_run": len(skipped),
        "left": sum(state.state == LEFT for state in states),
    }
    return {**counts, "digest": digest(table), "problems": problems, "out": str(out)}


def _open(grid: Grid, out: Path) -> None:
    """Make the folder, or accept the one of the same grid."""
    files.check_output(out, may_resume=GRID_FILE)
    if (out / GRID_FILE).exists():
        if files.read_json(out / GRID_FILE) != to_mapping(grid):
            raise OutputExists(
                f"--out {out} holds another sweep (see {out / GRID_FILE}); give another folder."
            )
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out {out} cannot be written: {error.strerror}; choose another folder."
        ) from None
    files.write_json(out / GRID_FILE, to_mapping(grid))


@final
@dataclass
class _Sweep:
    """One run of a sweep.

    Attributes:
        grid, out, context: as `run_sweep`'s.
        run: `executor.run` with the context.
        tasks: those whose references are wanted.
        errors: cell's key → what went wrong, in one line.
        problems: what went wrong beside the cells.
    """

    grid: Grid
    out: Path
    context: RunContext
    run: Any
    tasks: tuple[str, ...]
    errors: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    jobs: Jobs = field(init=False)

    def __post_init__(self) -> None:
        self._renew()

    def _renew(self) -> None:
        """Look at the folder anew: digests of datasets are parts of keys."""
        ours = {
            name: value for name, value in os.environ.items() if name.startswith("SURGICAI_VISION_")
        }
        self.jobs = Jobs(self.grid, self.out, command_line(), ours)

    def prepare(self, to_do: Sequence[CellState]) -> None:
        """Make the datasets, features and policies that cells share; a task whose dataset fails
        fails its cells.
        """
        needed = {state.cell.task: None for state in to_do}
        replayed = [
            task
            for task in self.tasks
            if self.grid.replay and not self._filed_reference("replay", task)
        ]
        for task in [*needed, *(task for task in replayed if task not in needed)]:
            try:
                prepare_dataset(
                    self.grid.config(task),
                    self.jobs.data_folder(task),
                    self.context,
                    demonstrations=self.grid.recorded,
                    views=self.grid.cameras or ("front",),
                    size=self.grid.size,
                    depth=self.grid.has_depth,
                    demonstrator=self.grid.demonstrator,
                    disturbance=self.grid.disturbance,
                    frame_stride=self.grid.frame_stride,
                    post_success_steps=self.grid.post_success_steps,
                )
            except SurgicaiError as error:
                for state in to_do:
                    if task == state.cell.task:
                        self._fail(state, error)
        self._renew()
        live = [state.cell for state in to_do if state.key not in self.errors]
        self._share("features", [job for cell in live for job in self.jobs.features(cell)])
        self._train_chains(
            [state for state in to_do if state.cell.chain and state.key not in self.errors]
        )

    def _share(self, title: str, jobs: Iterable[Job]) -> dict[str, SurgicaiError]:
        """Do jobs, each once; return the errors by key. What failed here fails again in the cell
        and is told there.
        """
        once = {job.key(): job for job in jobs}
        errors: dict[str, SurgicaiError] = {}

        def ended(job: Job, folder: Path, error: SurgicaiError | None) -> None:
            if error:
                errors[job.key()] = error

        if once:
            with self.context.stage(title, title) as progress:
                self.run(
                    list(once.values()), self.out / WORK, unit=title, progress=progress, ended=ended
                )
        return errors

    def _train_chains(self, states: Sequence[CellState]) -> None:
        """Train the policies of chains and file them; a chain that lacks one fails."""
        parts = {
            self.jobs.policy(part).key(): part
            for state in states
            for part in chain_parts(state.cell).values()
        }
        missing = [
            part
            for key, part in parts.items()
            if not self._is_filed(self.jobs.policy_folder(part), key)
        ]
        errors = self._share("policies", map(self.jobs.policy, missing))
        for key, part in parts.items():
            if (self.out / WORK / key).is_dir():
                _file(self.out / WORK / key, self.jobs.policy_folder(part), JOB_FILE, key)
        for state in states:
            for part in chain_parts(state.cell).values():
                error = errors.get(self.jobs.policy(part).key())
                if error and state.key not in self.errors:
                    self._fail(state, error)

    def _is_filed(self, folder: Path, key: str) -> bool:
        path = folder / JOB_FILE
        return path.exists() and files.read_json(path)["job"] == key

    def do(self, to_do: Sequence[CellState]) -> None:
        """Do the cells and the references, and file each as it ends."""
        places: dict[str, tuple[Path, str, CellState | None]] = {}
        jobs = []
        for state in to_do:
            if state.key not in self.errors:
                jobs.append(self.jobs.cell(state.cell))
                places[jobs[-1].key()] = (self.jobs.cell_folder(state.key), CELL_FILE, state)
        for name, task in self._references():
            job = self.jobs.reference(name, task)
            jobs.append(job)
            places[job.key()] = (self._reference_folder(name, task), REFERENCE_FILE, None)
        for key, (
            place,
            record,
            _,
        ) in places.items():  # done by a run that was killed before it could file them
            if (self.out / WORK / key).is_dir():
                _file(self.out / WORK / key, place, record, key)
        left = [job for job in jobs if not self._at(places[job.key()], job.key())]

        def ended(job: Job, folder: Path, error: SurgicaiError | None) -> None:
            place, record, state = places[folder.name]
            if error is None:
                _file(folder, place, record, folder.name)
            elif state:
                self._fail(state, error)
            else:
                self.problems.append(f"failed: {place.name}: {' '.join(str(error).split())}")

        if left:
            with self.context.stage("cells", "cells") as progress:
                self.run(left, self.out / WORK, unit="cells", progress=progress, ended=ended)

    def probe(self, cells: Sequence[Cell]) -> None:
        """Probe what the cells see, where the grid asks for it."""
        wanted = self.jobs.probes(cells) if self.grid.probe else {}
        places = {
            job.key(): (self.out / "probes" / name, PROBE_FILE, None)
            for name, job in wanted.items()
        }
        errors = self._share(
            "probes", [job for job in wanted.values() if not self._at(places[job.key()], job.key())]
        )
        for key, (place, record, _) in places.items():
            if (self.out / WORK / key).is_dir():
                _file(self.out / WORK / key, place, record, key)
            if key in errors:
                self.problems.append(
                    f"failed: probe {place.name}: {' '.join(str(errors[key]).split())}"
                )

    def _at(self, place: tuple[Path, str, CellState | None], key: str) -> bool:
        path = place[0] / place[1]
        return path.exists() and files.read_json(path).get("job") == key

    def _references(self) -> list[tuple[str, str]]:
        """Return (name, task) of the references that are not there."""
        wanted = [
            (name, on)
            for name, on in (("expert", self.grid.expert), ("replay", self.grid.replay))
            if on
        ]
        pairs = [(name, task) for task in self.tasks for name, _ in wanted]
        return [(name, task) for name, task in pairs if not self._filed_reference(name, task)]

    def _filed_reference(self, name: str, task: str) -> bool:
        path = self._reference_folder(name, task) / REFERENCE_FILE
        return (
            path.exists()
            and files.read_json(path).get("job") == self.jobs.reference(name, task).key()
        )

    def _reference_folder(self, name: str, task: str) -> Path:
        return self.out / "references" / f"{name}-{task}"

    def _fail(self, state: CellState, error: SurgicaiError) -> None:
        """Keep a cell's error, and its traceback where it was none of ours."""
        folder = self.jobs.cell_folder(state.key)
        folder.mkdir(parents=True, exist_ok=True)
        details = "\n".join([str(error), *getattr(error, "__notes__", [])])
        files.write_json(folder / FAILED_FILE, {"cell": to_mapping(state.cell), "error": details})
        self.errors[state.key] = " ".join(str(error).split())


JOB_FILE = "job.json"
"""Names the job that made a policy which chains share."""


def _file(folder: Path, place: Path, record: str, key: str) -> None:
    """Move a job's result to its place, its key in `record`; what was there is replaced."""
    path = folder / record
    files.write_json(path, {**(files.read_json(path) if path.exists() else {}), "job": key})
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(place, ignore_errors=True)
    os.rename(folder, place)
    files.sync_folder(place.parent)


def _collect(grid: Grid, out: Path) -> list[dict[str, Any]]:
    """Write `episodes.parquet` of all cells that are done and return its rows."""
    table = []
    for cell in grid.cells:
        key = grid.key(cell)
        if (out / "cells" / key / CELL_FILE).exists():
            table += [
                {**_about(grid, key, cell), **row}
                for row in read_rows(out / "cells" / key / "evaluation")
            ]
    files.write_bytes(out / EPISODES, parquet_bytes(table))
    return table


def _collect_probes(out: Path) -> None:
    """Write `probes.parquet` of all probes there are, one row an encoder and view set."""
    rows = [files.read_json(path) for path in sorted(out.glob(f"probes/*/{PROBE_FILE}"))]
    if rows:
        files.write_bytes(out / PROBES, parquet_bytes(rows))


def _about(grid: Grid, key: str, cell: Cell) -> dict[str, Any]:
    """Return what a row says of its cell."""
    return {
        "cell": key,
        "encoder": cell.encoder,
        "view": "+".join(cell.view),
        "training_seed": cell.seed,
        "trained_by": cell.policy,
        "recipe": cell.recipe,
        "demonstrations": cell.demonstrations or grid.recorded,
        "chain": cell.chain,
        "swap": cell.swap,
    }


def _store_run(grid: Grid, out: Path, problems: list[str], skipped: Sequence[CellState]) -> None:
    """Write what the report says of the run; only when something changed."""
    old = files.read_json(out / RUN_FILE) if (out / RUN_FILE).exists() else {}
    counts = ", ".join(map(str, grid.demonstrations))
    parts = [f"{counts} demonstrations of each task by the scripted {grid.demonstrator}"]
    parts += [f"executed with noise {grid.noise:g}"] if grid.noise else []
    parts += (
        [f"going on for {grid.post_success_steps} steps after their success"]
        if grid.post_success_steps
        else []
    )
    parts += [
        f"{axis} up to {getattr(grid.randomisation, axis):g}" for axis in grid.randomisation.on
    ]
    parts += [f"a frame every {grid.frame_stride} steps"] if grid.frame_stride > 1 else []
    seen = f"{', '.join(grid.views)} at {grid.size} × {grid.size}" if grid.views else "no images"
    taught = f"{', '.join(grid.policy)}, recipe {', '.join(grid.recipe)}"
    data = "; ".join(
        [
            ", ".join(parts),
            seen,
            taught,
            f"{grid.episodes} {grid.starts} starts from {grid.first_seed}",
        ]
    )
    run = {
        "title": "sweep",
        "command": old.get("command") or command_line(),
        "data": data,
        "not_run": problems,
    }
    lacking = [
        {"key": state.key, "cell": to_mapping(state.cell), "reason": state.reason}
        for state in skipped
    ]
    made = {**run, "skipped": lacking, "provenance": old.get("provenance") or provenance()}
    if made != old:
        files.write_json(out / RUN_FILE, made)
