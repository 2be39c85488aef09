"""Planning: which cells there are, what stands in the folder already, and the job that makes
each.
"""

import functools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, digest, to_mapping
from surgicai_vision.core.errors import BadFile, MissingWeights
from surgicai_vision.core.executor import Job, register_job
from surgicai_vision.core.files import read_json
from surgicai_vision.evaluation.storage import CELL_FILE
from surgicai_vision.experiments.run import OWN, Cell
from surgicai_vision.experiments.sweep.grid import Grid, chain_parts
from surgicai_vision.experiments.sweep.lerobot import LEROBOT_POLICIES
from surgicai_vision.experiments.sweep.selection import EVERYTHING, Choice, is_chosen
from surgicai_vision.features import encoders
from surgicai_vision.training import policies

REFERENCE_FILE = "reference.json"
PROBE_FILE = "probe.json"
CACHED, TO_DO, NOT_RUN, LEFT = "cached", "to do", "not run", "left"
STATES = (TO_DO, CACHED, NOT_RUN, LEFT)


LEARN = (
    "scene",
    "envs",
    "demos",
    "dataset",
    "features",
    "training",
    "experiments",
    "encoders",
    "policies",
)
EVALUATE = (*LEARN, "evaluation")
PACKAGES = ("mujoco", "numpy", "torch", "timm", "lerobot")
"""Sources and distributions that decide what a job of a sweep gives."""
for name, function, stages in (
    ("sweep-features", "encode_features", LEARN),
    ("sweep-policy", "train_policy", LEARN),
    ("sweep-probe", "run_probe", LEARN),
    ("sweep-cell", "run_cell", EVALUATE),
    ("sweep-reference", "run_reference", EVALUATE),
):
    register_job(
        name, f"surgicai_vision.experiments.sweep.jobs:{function}", stages=stages, packages=PACKAGES
    )


@dataclass(frozen=True)
class CellState:
    """A cell and what is known of it.

    Attributes:
        cell: the cell.
        key: its folder's name.
        state: one of `STATES`; "left" is a cell that this call was not asked for.
        reason: why it is not run, or why it is done again.
    """

    cell: Cell
    key: str
    state: str
    reason: str = ""

    @property
    def where(self) -> str:
        """The cell in words."""
        return f"{self.cell.task}, {self.cell.name}, seed {self.cell.seed}"


def plan(grid: Grid, out: Path, choice: Choice = EVERYTHING) -> list[CellState]:
    """Return every cell of `grid` with its state in the folder `out`; does no work."""
    jobs = Jobs(grid, out)
    missing = functools.lru_cache(functools.partial(_missing, accept_licence=grid.accept_licence))
    return [_state(grid.key(cell), cell, jobs, missing, choice) for cell in grid.cells]


def _missing(encoder: str, accept_licence: bool) -> str:
    """Return why an encoder's weights cannot be had, or "" where they are at hand."""
    try:
        encoders.find_weights(encoder, encoders.WeightsSource(accept_licence=accept_licence))
    except MissingWeights as error:
        return str(error)
    return ""


def _state(key: str, cell: Cell, jobs: "Jobs", missing: Any, choice: Choice) -> CellState:
    path = jobs.cell_folder(key) / CELL_FILE
    made = path.exists()
    if made and read_json(path).get("job") == jobs.cell_key(cell):
        return CellState(cell, key, CACHED)
    lack = missing(cell.encoder) if cell.encoder and cell.encoder != OWN else ""
    if lack:
        return CellState(cell, key, NOT_RUN, lack)
    if not is_chosen(cell, choice):
        return CellState(cell, key, LEFT)
    return CellState(cell, key, TO_DO, "made by other code or other data" if made else "")


class Jobs:
    """The jobs of a grid in the folder `out`.

    Args:
        grid: the grid.
        out: the sweep's folder.
        command: the command to be named beside each result.
        environment: variables for the workers, where an engine does not hand ours on.
    """

    def __init__(
        self, grid: Grid, out: Path, command: str = "", environment: Mapping[str, str] | None = None
    ):
        self.grid, self.out = grid, out
        self._where: dict[str, JSON] = {"command": command, "environment": dict(environment or {})}
        self._digests: dict[str, str | None] = {}

    def cell_folder(self, key: str) -> Path:
        """Return where a cell's result is filed."""
        return self.out / "cells" / key

    def data_folder(self, task: str) -> Path:
        """Return where a task's demonstrations and dataset are."""
        return self.out / "data" / task

    def policy_folder(self, part: Cell) -> Path:
        """Return where a policy that chains share is filed."""
        return self.out / "policies" / self.grid.key(part)

    def dataset_digest(self, task: str) -> str | None:
        """Return the digest of a task's dataset; None where it is not made yet."""
        if task not in self._digests:
            try:
                self._digests[task] = str(
                    read_json(self.data_folder(task) / "dataset" / names.META_FILE)["digest"]
                )
            except BadFile:
                self._digests[task] = None
        return self._digests[task]

    def cell_key(self, cell: Cell) -> str | None:
        """Return the key of a cell's job; None where it cannot be known yet."""
        return self.cell(cell).key() if self.dataset_digest(cell.task) else None

    def cell(self, cell: Cell) -> Job:
        """Return the job that trains and evaluates a cell, or evaluates the chain of policies made
        before.
        """
        parts = chain_parts(cell) if cell.chain else {}
        final = self.cell_folder(self.grid.key(cell))
        inputs = (
            [self.policy(part).key() for part in parts.values()] if parts else self._inputs(cell)
        )
        arguments = {
            "cell": to_mapping(cell),
            "seeds": self._seeds,
            "final": str(final.absolute()),
            "policies": {
                name: str(self.policy_folder(part).absolute()) for name, part in parts.items()
            },
            **self._common(cell),
        }
        return Job("sweep-cell", arguments, tuple(inputs), label=(*LABELS, "final", "policies"))

    def policy(self, part: Cell) -> Job:
        """Return the job that trains one policy of a chain, on its subtask's frames of whole
        procedures.
        """
        whole = replace(part, task=names.SUTURE)
        subtask = {} if part.task == names.SUTURE else {"subtask": part.task}
        arguments = {"cell": to_mapping(whole), **self._common(whole), "options": subtask}
        return Job("sweep-policy", arguments, tuple(self._inputs(whole)), label=LABELS)

    def features(self, cell: Cell) -> list[Job]:
        """Return the jobs that encode what a cell, or a chain's policies, see."""
        if not cell.encoder or cell.encoder == OWN:
            return []
        jobs = []
        for seen in _seen(cell):
            arguments = {"cell": to_mapping(seen), **self._common(seen)}
            jobs.append(Job("sweep-features", arguments, tuple(self._inputs(seen)), label=LABELS))
        return jobs

    def probes(self, cells: Iterable[Cell]) -> dict[str, Job]:
        """Return the probes of what cells see, by their folders' names; a chain and an `own`
        network have none.
        """
        jobs = {}
        for cell in cells:
            if cell.encoder and cell.encoder != OWN and not cell.chain:
                seen = Cell(cell.task, cell.encoder, cell.view, pool=cell.pool)
                arguments = {"cell": to_mapping(seen), **self._common(seen)}
                name = digest(to_mapping(seen))[:16]
                jobs[name] = Job("sweep-probe", arguments, tuple(self._inputs(seen)), label=LABELS)
        return jobs

    def reference(self, name: str, task: str) -> Job:
        """Return the job that evaluates the expert, or blind replay, on a task."""
        dataset = str((self.data_folder(task) / "dataset").absolute())
        config = to_mapping(self.grid.config(task))
        arguments: dict[str, JSON] = {
            "name": name, "config": config, "seeds": self._seeds, "dataset": dataset, **self._where
        }  # fmt: skip
        inputs = (self.dataset_digest(task) or "",) if name == "replay" else ()
        return Job("sweep-reference", arguments, inputs, label=LABELS)

    @property
    def _seeds(self) -> list[int]:
        """First seed of an evaluation's starts, and the one after its last."""
        return [self.grid.first_seed, self.grid.first_seed + self.grid.episodes]

    def _common(self, cell: Cell) -> dict[str, Any]:
        lerobot = (
            {"steps": self.grid.steps, "batch": self.grid.batch}
            if cell.policy in LEROBOT_POLICIES
            else {}
        )
        return {
            "dataset": str((self.data_folder(cell.task) / "dataset").absolute()),
            "accept_licence": self.grid.accept_licence,
            "options": lerobot,
            **self._where,
        }

    def _inputs(self, cell: Cell) -> list[str]:
        """Return hashes of what a cell reads: its dataset, its encoder, its recipe."""
        inputs = [self.dataset_digest(cell.task) or ""]
        if cell.encoder and cell.encoder != OWN:
            inputs.append(_card_digest(cell.encoder))
        if cell.policy not in LEROBOT_POLICIES:
            inputs.append(_recipe_digest(cell.policy, cell.recipe, json.dumps(cell.changes)))
        return inputs


LABELS = ("dataset", "accept_licence", "command", "environment")
"""Arguments that change where and how a job is done, and not its result."""


def _seen(cell: Cell) -> list[Cell]:
    """Return what a cell sees, view by view where that is possible, so that cells share it."""
    common: dict[str, Any] = {"pool": cell.pool}
    if cell.policy not in LEROBOT_POLICIES:
        recipe = policies.load_recipe(cell.policy, cell.recipe, cell.changes)
        if recipe.frame_stride > 1:
            common["change"] = (f"frame_stride={recipe.frame_stride}",)
    return [Cell(cell.task, cell.encoder, (view,), **common) for view in cell.view]


@functools.cache
def _card_digest(encoder: str) -> str:
    """Hash an encoder's card, which names its weights by their sha256."""
    return digest(to_mapping(encoders.encoder_card(encoder)))


@functools.cache
def _recipe_digest(policy: str, recipe: str, changes: str) -> str:
    return digest(to_mapping(policies.load_recipe(policy, recipe, json.loads(changes))))
