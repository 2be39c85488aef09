"""Plan: which runs there are, what stands in the folder already, and the job that makes each."""

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, digest, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, MissingWeights
from surgicai_vision.core.executor import Job, register_job
from surgicai_vision.core.files import read_json
from surgicai_vision.evaluation.storage import GRID_FILE, RESULT_FILE, read_versioned
from surgicai_vision.experiments.sweep.grid import Grid, parts_of, with_task
from surgicai_vision.experiments.sweep.selection import EVERYTHING, Choice, is_chosen
from surgicai_vision.features import encoders
from surgicai_vision.features.encoders import WeightsSource
from surgicai_vision.training import policies
from surgicai_vision.training.run_config import LEROBOT_POLICIES, OWN, RunConfig

REFERENCE_FILE = "reference.json"
PROBE_FILE = "probe.json"
TO_DO: Final = "to do"
CACHED: Final = "cached"
NOT_RUN: Final = "not run"
LEFT: Final = "left"
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
    ("sweep-run", "train_and_evaluate", EVALUATE),
    ("sweep-reference", "evaluate_reference", EVALUATE),
):
    register_job(
        name, f"surgicai_vision.experiments.sweep.jobs:{function}", stages=stages, packages=PACKAGES
    )


@dataclass(frozen=True)
class RunState:
    """A run and what is known of it.

    Attributes:
        run: the run.
        key: its folder's name.
        state: one of `STATES`; "left" is a run that this call was not asked for.
        reason: why it is not run, or why it is done again.
    """

    run: RunConfig
    key: str
    state: str
    reason: str = ""

    @property
    def where(self) -> str:
        """The run in words."""
        run = self.run
        return f"{run.task}, {run.name}, {run.demonstrations} demonstrations, seed {run.seed}"


def read_grid_of(folder: Path) -> Grid:
    """Return the grid of the sweep in `folder`.

    Raises:
        BadFile: there is none, or another version wrote it.
    """
    return from_mapping(Grid, read_versioned(folder / GRID_FILE)["grid"], str(folder / GRID_FILE))


def run_key(run: RunConfig) -> str:
    """Return the digest of everything that decides what a run is."""
    return digest(run)[:16]


def run_folder(out: Path, key: str) -> Path:
    """Return where a run's result is filed."""
    return out / "runs" / key


def plan(grid: Grid, out: Path, choice: Choice = EVERYTHING) -> list[RunState]:
    """Return every run of `grid` with its state in the folder `out`; does no work.

    Raises:
        UnknownName: a recipe, or a change of one, that does not exist.
        InputError: a recipe that is fed progress, which no sweep says.
    """
    for run in grid.runs:
        if run.policy not in LEROBOT_POLICIES:
            policies.check_progress_from(policies.recipe_of(run), None)
    jobs = Jobs(grid, out)
    weights = WeightsSource(accept_licence=grid.accept_licence)
    missing = functools.lru_cache(functools.partial(_missing, weights=weights))
    return [_state(run, jobs, missing, choice) for run in grid.runs]


def _missing(encoder: str, weights: WeightsSource) -> str:
    """Return why an encoder's weights cannot be had, or "" where they are at hand."""
    try:
        encoders.find_weights(encoder, weights)
    except MissingWeights as error:
        return str(error)
    return ""


def _state(run: RunConfig, jobs: "Jobs", missing: Callable[[str], str], choice: Choice) -> RunState:
    """Return a run with its state."""
    key = run_key(run)
    path = run_folder(jobs.out, key) / RESULT_FILE
    is_made = path.exists()
    if is_made and read_json(path).get("job") == jobs.key_of_run(run):
        return RunState(run, key, CACHED)
    lack = missing(run.encoder) if run.encoder and run.encoder != OWN else ""
    if lack:
        return RunState(run, key, NOT_RUN, lack)
    if not is_chosen(run, choice):
        return RunState(run, key, LEFT)
    return RunState(run, key, TO_DO, "made by other code or other data" if is_made else "")


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
        self.grid = grid
        self.out = out
        self._where: dict[str, JSON] = {"command": command, "environment": dict(environment or {})}
        self._digests: dict[str, str | None] = {}

    def data_folder(self, task: str) -> Path:
        """Return where a task's demonstrations and dataset are."""
        return self.out / "data" / task

    def policy_folder(self, part: RunConfig) -> Path:
        """Return where a policy that hierarchical policies share is filed."""
        return self.out / "policies" / run_key(part)

    def dataset_digest(self, task: str) -> str | None:
        """Return the digest of a task's dataset; None where it is not made yet."""
        if task not in self._digests:
            try:
                meta = read_json(self.data_folder(task) / "dataset" / names.META_FILE)
                self._digests[task] = str(meta["digest"])
            except BadFile:
                self._digests[task] = None
        return self._digests[task]

    def key_of_run(self, run: RunConfig) -> str | None:
        """Return the key of a run's job; None where it cannot be known yet."""
        return self.run(run).key() if self.dataset_digest(run.task) else None

    def run(self, run: RunConfig) -> Job:
        """Return the job of a run.

        It trains and evaluates, or evaluates the hierarchical policy of policies made before.
        """
        parts = parts_of(run) if run.is_hierarchical else {}
        inputs = [self.policy(part).key() for part in parts.values()] or self._inputs(run)
        arguments = {
            "run": to_mapping(run),
            "final": str(run_folder(self.out, run_key(run)).absolute()),
            "policies": {
                name: str(self.policy_folder(part).absolute()) for name, part in parts.items()
            },
            **self._common(run),
        }
        return Job("sweep-run", arguments, tuple(inputs), label=(*LABELS, "final", "policies"))

    def policy(self, part: RunConfig) -> Job:
        """Return the job that trains one policy of a hierarchical policy.

        It is trained on its subtask's frames of whole procedures.
        """
        whole = replace(part, env=with_task(part.env, names.SUTURE))
        subtask = None if part.task == names.SUTURE else part.task
        arguments = {"run": to_mapping(whole), "subtask": subtask, **self._common(whole)}
        return Job("sweep-policy", arguments, tuple(self._inputs(whole)), label=LABELS)

    def features(self, run: RunConfig) -> list[Job]:
        """Return the jobs that encode what a run sees, view by view, so that runs share them."""
        if not run.encoder or run.encoder == OWN:
            return []
        changes: tuple[str, ...] = ()
        if run.policy not in LEROBOT_POLICIES:
            stride = policies.recipe_of(run).frame_stride
            changes = (f"frame_stride={stride}",) if stride > 1 else ()
        jobs = []
        for view in run.views:
            seen = RunConfig(run.env, run.encoder, (view,), pool=run.pool, changes=changes)
            arguments = {"run": to_mapping(seen), **self._common(seen)}
            jobs.append(Job("sweep-features", arguments, tuple(self._inputs(seen)), label=LABELS))
        return jobs

    def probes(self, runs: Iterable[RunConfig]) -> dict[str, Job]:
        """Return the probes of what runs see, by their folders' names.

        A hierarchical policy and a policy with a network of its own have none.
        """
        jobs = {}
        for run in runs:
            if run.encoder and run.encoder != OWN and not run.is_hierarchical:
                seen = RunConfig(run.env, run.encoder, run.views, pool=run.pool)
                arguments = {"run": to_mapping(seen), **self._common(seen)}
                inputs = tuple(self._inputs(seen))
                jobs[run_key(seen)] = Job("sweep-probe", arguments, inputs, label=LABELS)
        return jobs

    def reference(self, name: str, task: str) -> Job:
        """Return the job that evaluates the expert, or the replay, on a task."""
        run = RunConfig(self.grid.config(task), policy=name, starts=self.grid.bank)
        arguments: dict[str, JSON] = {
            "run": to_mapping(run),
            "dataset": self._dataset(task),
            **self._where,
        }
        inputs = (self.dataset_digest(task) or "",) if name == "replay" else ()
        return Job("sweep-reference", arguments, inputs, label=LABELS)

    def _dataset(self, task: str) -> str:
        return str((self.data_folder(task) / "dataset").absolute())

    def _common(self, run: RunConfig) -> dict[str, JSON]:
        return {
            "dataset": self._dataset(run.task),
            "accept_licence": self.grid.accept_licence,
            **self._where,
        }

    def _inputs(self, run: RunConfig) -> list[str]:
        """Return hashes of what a run reads: its dataset, its encoder, its recipe."""
        inputs = [self.dataset_digest(run.task) or ""]
        if run.encoder and run.encoder != OWN:
            inputs.append(_card_digest(run.encoder))
        if run.policy not in LEROBOT_POLICIES:
            inputs.append(_recipe_digest(run.policy, run.recipe, run.changes, run.privileged))
        return inputs


LABELS = ("dataset", "accept_licence", "command", "environment")
"""Arguments that change where and how a job is done, and not its result."""


@functools.cache
def _card_digest(encoder: str) -> str:
    """Hash an encoder's card, which names its weights by their sha256."""
    return digest(to_mapping(encoders.encoder_card(encoder)))


@functools.cache
def _recipe_digest(policy: str, recipe: str, changes: tuple[str, ...], privileged: bool) -> str:
    """Hash a recipe with its changes; read once for all runs that share it."""
    run = RunConfig(policy=policy, recipe=recipe, changes=changes, privileged=privileged)
    return digest(to_mapping(policies.recipe_of(run)))
