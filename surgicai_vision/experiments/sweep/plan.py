"""Plan: which runs there are, what is in the folder already, and the job that makes each."""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from surgicai_vision.core import names
from surgicai_vision.core.cameras import CAMERAS
from surgicai_vision.core.config import JSON, digest, from_mapping, to_identity, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, MissingWeights
from surgicai_vision.core.executor import Job, register_job
from surgicai_vision.core.files import read_json
from surgicai_vision.core.plugins import DISTRIBUTION
from surgicai_vision.core.tasks import TASKS
from surgicai_vision.demos.store import demos_digest, list_demos
from surgicai_vision.envs import check_world
from surgicai_vision.envs.upset import check_upset_task
from surgicai_vision.evaluation.robustness.axes import SHIFTS, shifted_config
from surgicai_vision.evaluation.storage import GRID_FILE, RESULT_FILE, read_versioned
from surgicai_vision.experiments.plan_config import plan_of
from surgicai_vision.experiments.prepare import check_dataset, demos_folders
from surgicai_vision.experiments.sweep.experiment import Experiment, Training
from surgicai_vision.experiments.sweep.grid import Grid
from surgicai_vision.experiments.sweep.lerobot import OPTIONS
from surgicai_vision.experiments.sweep.rl_grid import RLGrid
from surgicai_vision.experiments.sweep.selection import EVERYTHING, Choice, is_chosen
from surgicai_vision.experiments.training_check import check_training
from surgicai_vision.features import encoders
from surgicai_vision.features.encoders import ENCODERS, WeightsSource
from surgicai_vision.rl.extra import check_extra
from surgicai_vision.training import policies
from surgicai_vision.training.policies import POLICIES
from surgicai_vision.training.run_config import OWN, RunConfig

REFERENCE_FILE = "reference.json"
PROBE_FILE = "probe.json"
UNFINISHED = "unfinished"
"""Folder of a sweep in which runs and trainings work, one folder per job."""
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
EVALUATE = (*LEARN, "detection", "evaluation")
RL = ("scene", "envs", "demos", "training", "experiments", "policies", "evaluation", "rl")
PACKAGES = ("mujoco", "numpy", "torch", "timm", "lerobot")
RL_PACKAGES = ("mujoco", "numpy", "torch", "stable-baselines3", "sb3-contrib", "d3rlpy")
"""Sources and distributions that decide the result of a sweep's job."""
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
for name, function in (("sweep-actor", "train_actor"), ("sweep-rl", "train_and_evaluate")):
    register_job(
        name,
        f"surgicai_vision.experiments.sweep.rl_jobs:{function}",
        stages=RL,
        packages=RL_PACKAGES,
    )


@dataclass(frozen=True)
class RunState:
    """A run and what is known of it.

    Attributes:
        run: the run.
        key: its folder's name.
        state: one of `STATES`; "left" is a run that this call did not choose.
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
        parts = [run.task, run.name]
        parts += [f"{run.demonstrations} demonstrations"] if run.demonstrations else []
        parts += [run.condition] if run.condition else []
        return ", ".join([*parts, f"seed {run.seed}"])


def lacking(states: Sequence[RunState]) -> dict[str, list[RunState]]:
    """Return each reason why runs are not run → these runs."""
    runs: dict[str, list[RunState]] = {}
    for state in states:
        if state.state == NOT_RUN:
            runs.setdefault(state.reason, []).append(state)
    return runs


def read_experiment_of(folder: Path) -> Experiment:
    """Return the grid or the plan of the sweep in `folder`.

    Raises:
        BadFile: there is none, or another version wrote it.
    """
    path = folder / GRID_FILE
    stored = read_versioned(path)
    if "plan" in stored:
        return plan_of(stored["plan"], str(path))
    if "rl_grid" in stored:
        return from_mapping(RLGrid, stored["rl_grid"], str(path))
    return from_mapping(Grid, stored["grid"], str(path))


def training_key(training: Training) -> str:
    """Return the digest of everything that decides what a shared policy is."""
    return digest(to_identity(training))[:16]


def run_key(run: RunConfig) -> str:
    """Return the digest of everything that decides what a run is."""
    return digest(to_identity(run))[:16]


def run_folder(out: Path, key: str) -> Path:
    """Return where a run's result is filed."""
    return out / "runs" / key


def plan(experiment: Experiment, out: Path, choice: Choice = EVERYTHING) -> list[RunState]:
    """Return every run of `experiment` with its state in the folder `out`; does no work.

    Raises:
        UnknownName: a recipe, a change of one, or a pool that does not exist.
        InputError: a policy that cannot be trained on its dataset (`training_check`), one that
            chooses subtasks where one that acts is needed, a dataset that cannot be recorded or
            rendered, upsets in a task that has none, or a world that geometry forbids.
    """
    if any(run.algo for run in experiment.runs):
        check_extra("A sweep over algorithms", *LIBRARIES)
    for dataset in experiment.datasets.values():
        check_dataset(dataset)
    for run in experiment.runs:
        if run.upset:
            check_upset_task(run.task)
    for run in experiment.runs:
        if experiment.needs(run):
            continue
        if not experiment.parts(run):
            _check_acts(run.policy)
        for training in trainings_of(experiment, run):
            if not training.run.algo:
                dataset = experiment.datasets[training.dataset]
                check_training(training.run, dataset, training.subtask)
        if is_chosen(run, choice):
            _check_worlds(experiment, run)
    jobs = Jobs(experiment, out)
    weights = WeightsSource(accept_licence=experiment.accept_licence)
    missing = functools.lru_cache(functools.partial(_missing, weights=weights))
    return [_state(run, jobs, missing, choice) for run in experiment.runs]


def trainings_of(experiment: Experiment, run: RunConfig) -> list[Training]:
    """Return the policies that must be trained for a run.

    These are its parts, or its own policy, and the learners that act in their demonstrations.
    """
    trainings = list(experiment.parts(run).values())
    trainings = trainings or [Training(run, experiment.dataset_of(run))]
    for training in trainings:  # grows by what the learners are trained on
        if training.dataset in experiment.learners:
            trainings.append(experiment.learners[training.dataset])
    return trainings


def _check_worlds(experiment: Experiment, run: RunConfig) -> None:
    """Refuse a run if geometry forbids a world that it is trained or evaluated in."""
    for training in trainings_of(experiment, run):
        env = experiment.datasets[training.dataset].env
        check_world(env, f"demonstrations {training.dataset}")
    env = run.env
    if run.shift:
        env = shifted_config(env, SHIFTS[run.shift.axis], run.shift.strength)
    check_world(env, f"condition {run.condition}" if run.condition else f"task {run.task}")


def _check_acts(policy: str) -> None:
    """Refuse a policy that cannot be evaluated by itself."""
    if policies.policy_plugin(policy).target != names.STAGE:
        return
    raise InputError(
        f"policy: '{policy}' chooses subtasks and does not act; it is evaluated over a policy for "
        "each subtask: write `hierarchical:` instead (docs/sweeps.md)."
    )


def _missing(encoder: str, weights: WeightsSource) -> str:
    """Return why an encoder's weights are not available, or "" where they are at hand."""
    try:
        encoders.find_weights(encoder, weights)
    except MissingWeights as error:
        return str(error)
    return ""


def _state(run: RunConfig, jobs: "Jobs", missing: Callable[[str], str], choice: Choice) -> RunState:
    """Return a run with its state."""
    key = run_key(run)
    needs = jobs.experiment.needs(run)
    if needs:
        return RunState(run, key, NOT_RUN, needs)
    path = run_folder(jobs.out, key) / RESULT_FILE
    is_made = path.exists()
    if is_made and read_json(path).get("job") == jobs.key_of_run(run):
        return RunState(run, key, CACHED)
    trainings = trainings_of(jobs.experiment, run)
    needed = {training.run.encoder for training in trainings} - {None, OWN}
    lacks = [lack for encoder in sorted(map(str, needed)) if (lack := missing(encoder))]
    if lacks:
        return RunState(run, key, NOT_RUN, " ".join(lacks))
    if not is_chosen(run, choice):
        return RunState(run, key, LEFT)
    return RunState(run, key, TO_DO, "made by other code or other data" if is_made else "")


class Jobs:
    """The jobs of an experiment in the folder `out`.

    Args:
        experiment: the grid or the plan.
        out: the sweep's folder.
        command: the command to store with each result.
        environment: variables for the workers, where an engine does not pass ours on.
        device: where to encode and train, one of `features.devices.DEVICES`.
    """

    def __init__(
        self,
        experiment: Experiment,
        out: Path,
        command: str = "",
        environment: Mapping[str, str] | None = None,
        device: str | None = None,
    ):
        self.experiment = experiment
        self.out = out
        self._where: dict[str, JSON] = {"command": command, "environment": dict(environment or {})}
        self._device = device
        self._digests: dict[str, str | None] = {}
        self._recipes: dict[tuple[str, str, tuple[str, ...], bool], str] = {}

    def data_folder(self, name: str) -> Path:
        """Return where a dataset and its demonstrations are."""
        return self.out / "data" / name

    def policy_folder(self, training: Training) -> Path:
        """Return where a policy that runs share is filed."""
        return self.out / "policies" / training_key(training)

    def dataset_digest(self, name: str) -> str | None:
        """Return the digest of a dataset; None where it is not made yet."""
        if name not in self._digests:
            try:
                self._digests[name] = self._digest_of(name)
            except BadFile:
                self._digests[name] = None
        return self._digests[name]

    def _digest_of(self, name: str) -> str:
        """Return the digest of a dataset, or of demonstrations of which nothing is rendered.

        Raises:
            BadFile: it is not made yet.
        """
        folder = self.data_folder(name)
        if not self.experiment.datasets[name].demonstrations.view:
            return demos_digest(list_demos(folder / "demos"))
        return str(read_json(folder / "dataset" / names.META_FILE)["digest"])

    def datasets_of(self, run: RunConfig) -> tuple[str, ...]:
        """Return the names of the datasets that a run's policies are trained on."""
        if run.algo and not run.demonstrations:
            return ()
        parts = self.experiment.parts(run).values()
        return tuple(dict.fromkeys(part.dataset for part in parts)) or (
            self.experiment.dataset_of(run),
        )

    def key_of_run(self, run: RunConfig) -> str | None:
        """Return the key of a run's job; None where it cannot be known yet."""
        known = all(self.dataset_digest(name) for name in self.datasets_of(run))
        return self.run(run).key() if known else None

    def run(self, run: RunConfig, processes: int = 1) -> Job:
        """Return the job of a run.

        It trains and evaluates, or evaluates policies made before, the episodes in `processes`
        processes.
        """
        if run.algo:
            return self._reinforcement(run, processes)
        parts = self.experiment.parts(run)
        dataset = self.datasets_of(run)[0]
        inputs = [self.policy(part).key() for part in parts.values()] or self._inputs(run, dataset)
        evaluated = self.experiment.evaluated(run)
        arguments = {
            "run": to_mapping(run),
            "final": str(run_folder(self.out, run_key(run)).absolute()),
            "policies": {
                name: str(self.policy_folder(part).absolute()) for name, part in parts.items()
            },
            **to_mapping(evaluated),
            "processes": processes,
            **self._common(dataset),
        }
        return self._with_scratch(Job("sweep-run", arguments, tuple(inputs), label=RUN_LABELS))

    def policy(self, training: Training) -> Job:
        """Return the job that trains a policy that runs share."""
        if training.run.algo:
            return self._actor(training)
        name = training.dataset
        demos = demos_folders(self.experiment.datasets[name], self.data_folder(name))
        arguments = {
            "run": to_mapping(training.run),
            "subtask": training.subtask,
            "encodes_all": training.encodes_all,
            "demos": [str(folder.absolute()) for folder in demos],
            **self._common(training.dataset),
        }
        inputs = tuple(self._inputs(training.run, training.dataset))
        label = (*LABELS, "demos")
        return self._with_scratch(Job("sweep-policy", arguments, inputs, label=label))

    def _actor(self, training: Training) -> Job:
        """Return the job that trains an actor that whole procedures share."""
        run = training.run
        arguments = {"run": to_mapping(run), **self._learning(run)}
        return self._with_scratch(Job("sweep-actor", arguments, self._demos(run), label=RL_LABELS))

    def _reinforcement(self, run: RunConfig, processes: int) -> Job:
        """Return the job that trains an actor, or PPO over actors made before, and evaluates it."""
        parts = self.experiment.parts(run)
        inputs = tuple(self.policy(part).key() for part in parts.values()) or self._demos(run)
        arguments = {
            "run": to_mapping(run),
            "final": str(run_folder(self.out, run_key(run)).absolute()),
            "policies": {
                name: str(self.policy_folder(part).absolute()) for name, part in parts.items()
            },
            "processes": processes,
            **self._learning(run),
        }
        return self._with_scratch(Job("sweep-rl", arguments, inputs, label=RL_LABELS))

    def _learning(self, run: RunConfig) -> dict[str, JSON]:
        """Return the arguments that jobs of reinforcement and offline learning share."""
        experiment = self.experiment
        assert isinstance(experiment, RLGrid)
        demos = self.data_folder(experiment.dataset_of(run)) / "demos"
        learns_from_demos = run.demonstrations and not run.is_hierarchical
        return {
            "decisions": experiment.decisions if run.is_hierarchical else 0,
            "validation": experiment.validation,
            "save_every": experiment.save_every,
            "demos": str(demos.absolute()) if learns_from_demos else "",
            **self._where,
        }

    def _demos(self, run: RunConfig) -> tuple[str, ...]:
        """Return the digests of the demonstrations that a run learns from."""
        return tuple(self.dataset_digest(name) or "" for name in self.datasets_of(run))

    def _with_scratch(self, job: Job) -> Job:
        """Add the folder in which a killed job continues; no other job uses it."""
        scratch = str((self.out / UNFINISHED / job.key()).absolute())
        arguments = {**job.arguments, "scratch": scratch}
        return replace(job, arguments=arguments, label=(*job.label, "scratch"))

    def features(self, run: RunConfig) -> list[Job]:
        """Return the jobs that encode what a run sees, view by view, so that runs share them."""
        parts = tuple(self.experiment.parts(run).values()) or (
            Training(run, self.experiment.dataset_of(run)),
        )
        return [job for part in parts if part.encodes_all for job in self._features(part)]

    def _features(self, training: Training) -> list[Job]:
        """Return the jobs that encode what a policy sees."""
        run = training.run
        if not run.encoder or run.encoder == OWN:
            return []
        changes: tuple[str, ...] = ()
        if not run.by_lerobot_train:
            stride = policies.recipe_of(run).frame_stride
            changes = (f"frame_stride={stride}",) if stride > 1 else ()
        jobs = []
        for view in run.views:
            seen = RunConfig(run.env, run.encoder, (view,), pool=run.pool, changes=changes)
            arguments = {"run": to_mapping(seen), **self._common(training.dataset)}
            inputs = tuple(self._inputs(seen, training.dataset))
            jobs.append(Job("sweep-features", arguments, inputs, label=LABELS))
        return jobs

    def probes(self, runs: Iterable[RunConfig]) -> dict[str, Job]:
        """Return the probes of what runs see, by their folders' names.

        A hierarchical policy and a policy with a network of its own have none.
        """
        jobs = {}
        for run in runs:
            if run.encoder and run.encoder != OWN and not run.is_hierarchical:
                dataset = self.experiment.dataset_of(run)
                seen = RunConfig(run.env, run.encoder, run.views, pool=run.pool)
                arguments = {"run": to_mapping(seen), **self._common(dataset)}
                inputs = tuple(self._inputs(seen, dataset))
                jobs[run_key(seen)] = Job("sweep-probe", arguments, inputs, label=LABELS)
        return jobs

    def reference(self, run: RunConfig) -> Job:
        """Return the job that evaluates what is not trained: the expert, or the replay."""
        replayed = self.experiment.dataset_of(run) if run.policy == "replay" else None
        arguments: dict[str, JSON] = {
            "run": to_mapping(run),
            "dataset": self._dataset(replayed) if replayed else "",
            **self._where,
        }
        inputs = [self.dataset_digest(replayed) or ""] if replayed else []
        inputs += _other_versions(run)
        return Job("sweep-reference", arguments, tuple(inputs), label=LABELS)

    def _dataset(self, name: str) -> str:
        return str((self.data_folder(name) / "dataset").absolute())

    def _common(self, dataset: str) -> dict[str, JSON]:
        return {
            "dataset": self._dataset(dataset),
            "accept_licence": self.experiment.accept_licence,
            "device": self._device,
            **self._where,
        }

    def _inputs(self, run: RunConfig, dataset: str) -> list[str]:
        """Return what a run depends on.

        These are its dataset, its encoder, its recipe or options, and other distributions.
        """
        inputs = [self.dataset_digest(dataset) or ""]
        if run.encoder and run.encoder != OWN:
            inputs.append(_card_digest(run.encoder))
        if run.by_lerobot_train:
            inputs.extend(OPTIONS.get(run.policy, ()))
        else:
            inputs.append(self._recipe_digest(run))
        return [*inputs, *_other_versions(run)]

    def _recipe_digest(self, run: RunConfig) -> str:
        """Hash a run's recipe with its changes; read once for all runs that share it."""
        key = (run.policy, run.recipe, run.changes, run.privileged)
        if key not in self._recipes:
            self._recipes[key] = digest(to_identity(policies.recipe_of(run)))
        return self._recipes[key]


LABELS = ("dataset", "accept_licence", "device", "command", "environment")
"""Arguments that change where and how a job is done, but not its result."""
RUN_LABELS = (*LABELS, "final", "policies", "processes")
RL_LABELS = (*RUN_LABELS, "demos")
LIBRARIES = ("stable_baselines3", "sb3_contrib", "d3rlpy")
"""What a sweep over algorithms imports."""


@functools.cache
def _card_digest(encoder: str) -> str:
    """Hash an encoder's card, which names its weights by their sha256."""
    return digest(to_mapping(encoders.encoder_card(encoder)))


def _other_versions(run: RunConfig) -> list[str]:
    """Return the name and version of each other distribution whose parts a run uses.

    A part that a script registers without a distribution has no version.
    """
    owners = {
        TASKS.distribution(run.task),
        POLICIES.distribution(run.policy),
        ENCODERS.distribution(run.encoder or ""),
        *(CAMERAS.distribution(names.camera_of(view)) for view in run.views),
    }
    versions = []
    for owner in sorted(owners - {DISTRIBUTION}):
        with suppress(PackageNotFoundError):
            versions.append(f"{owner} {version(owner)}")
    return versions
