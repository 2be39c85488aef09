"""Estimating: how long a sweep will take, from what its cells took already and else from figures
measured once.

The figures are seconds on one core of a two-core Xeon virtual machine with software rendering; on
another machine they are wrong by its speed, until the first cells are done: then their own times
count.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import read_json
from surgicai_vision.core.tasks import task_steps
from surgicai_vision.evaluation.storage import CELL_FILE
from surgicai_vision.experiments.run import OWN, Cell
from surgicai_vision.experiments.sweep.grid import Grid, chain_parts
from surgicai_vision.experiments.sweep.lerobot import LEROBOT_POLICIES
from surgicai_vision.experiments.sweep.plan import TO_DO, CellState, Jobs

FRAMES: Mapping[str, int] = MappingProxyType(
    {"grasp": 70, "place": 90, "insert": 90, "handoff": 110, "pullout": 90, "suture": 450}
)
"""Frames of a demonstration by the expert, about."""
RECORD, RENDER = 0.0045, 0.008
"""Per frame recorded; per view and frame rendered and written [s]."""
ENCODE: Mapping[str, float] = MappingProxyType(
    {"imagenet-lite": 0.017, "imagenet-lite-early": 0.006, "random-conv": 0.006, "random": 0.035}
)
ENCODE_ELSE = 0.08
"""Per frame encoded [s]: the light encoders, and a ResNet-50 or a small transformer."""
LIVE = 2.5
"""Encoding in an evaluation takes so many times as long a frame: eight at a time at most, and
seldom as many.
"""
TRAIN = 4e-5
"""Per frame and epoch [s]."""
EPOCHS = 30
STEP, SEE = 0.002, 0.006
"""Per control step of an evaluation; and per view seen [s]."""
LEROBOT: Mapping[str, float] = MappingProxyType({"act": 0.15, "diffusion": 0.25})
"""Per image of a batch in one update [s]."""
ACT: Mapping[str, float] = MappingProxyType({"act": 0.02, "diffusion": 0.1})
"""Per control step, what LeRobot's policies take themselves [s]."""
START = 3.0
"""Per cell [s]: what each needs to begin."""


def estimate(grid: Grid, out: Path, states: Sequence[CellState], workers: int) -> dict[str, Any]:
    """Return {"seconds": of the whole run with so many workers, "source": what the estimate stands
    on}.
    """
    to_do = [state.cell for state in states if state.state == TO_DO]
    jobs = Jobs(grid, out)
    tasks = {cell.task for cell in to_do if not jobs.dataset_digest(cell.task)}
    shared = sum(_data_seconds(grid, task) for task in tasks)
    seen = {(cell.task, cell.encoder, view) for cell in to_do for view in cell.view}
    shared += sum(_frames(grid, task) * _encode(encoder) for task, encoder, view in seen)
    shared += sum(
        _train(grid, part)
        for part in {part for cell in to_do if cell.chain for part in _parts(cell)}
    )
    ratios = _ratios(grid, jobs, states)
    speed = sum(ratios) / len(ratios) if ratios else 1.0
    cells = sum(_cell_seconds(grid, cell) for cell in to_do) * speed
    source = (
        f"by the time {len(ratios)} cells took here"
        if ratios
        else "by figures of another machine; a rough guess"
    )
    return {"seconds": round((shared * speed + cells) / max(1, workers)), "source": source}


def _ratios(grid: Grid, jobs: Jobs, states: Sequence[CellState]) -> list[float]:
    """Return time taken over time estimated of the cells that are done."""
    ratios = []
    for state in states:
        try:
            seconds = read_json(jobs.cell_folder(state.key) / CELL_FILE)["seconds"]
        except (BadFile, KeyError):
            continue
        ratios.append(sum(seconds.values()) / _cell_seconds(grid, state.cell))
    return ratios


def _parts(cell: Cell) -> list[Cell]:
    return list(chain_parts(cell).values()) if cell.chain else [cell]


def _frames(grid: Grid, task: str, demonstrations: int | None = None) -> int:
    return FRAMES[task] * (demonstrations or grid.recorded)


def _data_seconds(grid: Grid, task: str) -> float:
    return _frames(grid, task) * (
        RECORD + RENDER * len(grid.cameras) * (2 if grid.has_depth else 1)
    )


def _encode(encoder: str | None) -> float:
    return 0.0 if encoder in (None, OWN) else ENCODE.get(str(encoder), ENCODE_ELSE)


def _train(grid: Grid, cell: Cell) -> float:
    if cell.policy in LEROBOT_POLICIES:
        return grid.steps * grid.batch * LEROBOT[cell.policy] * (1 if cell.encoder == OWN else 0.1)
    return _frames(grid, cell.task, cell.demonstrations) * TRAIN * (cell.epochs or EPOCHS)


def _cell_seconds(grid: Grid, cell: Cell) -> float:
    """Return the estimate of one cell: training, unless chains share it, and evaluation."""
    steps = grid.episodes * task_steps(cell.task)
    look = len(cell.view) * (SEE + LIVE * _encode(cell.encoder))
    return (
        START
        + (0.0 if cell.chain else _train(grid, cell))
        + steps * (STEP + look + ACT.get(cell.policy, 0.0))
    )
