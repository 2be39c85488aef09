"""Driver: make what runs share first, each thing once; then do the runs side by side.

A finished job is filed by one rename from `work/` to its place. A sweep that was killed in between
finds it in `work/`.
"""

import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from surgicai_vision.core import files
from surgicai_vision.core.config import digest, to_mapping
from surgicai_vision.core.errors import InputError, OutputExists, SurgicaiError
from surgicai_vision.core.executor import Job, RunContext, claim
from surgicai_vision.core.executor import run as run_jobs
from surgicai_vision.evaluation.provenance import command_line
from surgicai_vision.evaluation.storage import FAILED_FILE, FORMAT, GRID_FILE, RESULT_FILE, Row
from surgicai_vision.experiments.dagger import learner_of
from surgicai_vision.experiments.prepare import make_dataset
from surgicai_vision.experiments.sweep.collect import EVALUATION, collect, collect_probes, store_run
from surgicai_vision.experiments.sweep.experiment import Experiment, Training
from surgicai_vision.experiments.sweep.plan import (
    CACHED,
    LEFT,
    NOT_RUN,
    PROBE_FILE,
    REFERENCE_FILE,
    TO_DO,
    UNFINISHED,
    Jobs,
    RunState,
    lacking,
    plan,
    read_experiment_of,
    run_folder,
)
from surgicai_vision.experiments.sweep.selection import EVERYTHING, Choice
from surgicai_vision.training.run_config import RunConfig

WORK = "work"
JOB_FILE = "job.json"
"""Names the job that made a policy which runs share."""
ATTEMPTS = 3
"""How often a run is started if its worker dies."""


def run_sweep(
    experiment: Experiment,
    out: Path,
    context: RunContext,
    attempts: int = ATTEMPTS,
    choice: Choice = EVERYTHING,
    device: str | None = None,
) -> Row:
    """Do every run that is not done and can be done.

    Args:
        experiment: the runs, a grid or a plan.
        out: folder to make or to continue.
        context: processes, engine and progress; the result does not depend on them.
        attempts: how often a run is started if its worker dies.
        choice: the runs to work on; others that are not done yet are left for another call.
        device: where to encode and train, one of `features.devices.DEVICES`; by default a GPU
            encodes, if there is one, and the CPU trains.

    Returns:
        {"runs", "done" (by this call), "cached", "failed", "not_run", "left", "failed_beside" (the
        references and probes that failed), "digest" (of all rows there are), "problems": one line
        for each failed run, reason why runs were not done, and failed reference or probe}.

    Raises:
        InputError: `out` cannot be written, or another sweep is at work in it.
        OutputExists: `out` holds something else.
        UnknownName: a recipe that does not exist; before any work.
    """
    plan(experiment, out, choice)  # refuses what cannot be done before anything is written
    _open(experiment, out)
    with claim(out / WORK):
        _extend(experiment, out)
        states = plan(experiment, out, choice)
        asked = [state.run for state in states if state.state != LEFT]
        sweep = _Sweep(experiment, out, context, attempts, experiment.references(asked), device)
        to_do = [state for state in states if state.state == TO_DO]
        sweep.prepare(to_do)
        sweep.do(to_do)
        sweep.probe(
            [
                state.run
                for state in states
                if state.state in (CACHED, TO_DO) and state.key not in sweep.errors
            ]
        )
        shutil.rmtree(out / WORK)
    skipped = [state for state in states if state.state == NOT_RUN]
    problems = [f"not run, {len(runs)} runs: {why}" for why, runs in lacking(states).items()]
    problems += [
        f"failed: {state.where}: {sweep.errors[state.key]}"
        for state in to_do
        if state.key in sweep.errors
    ]
    table = collect(experiment, out)
    collect_probes(out)
    store_run(experiment, out, sweep.problems, skipped)
    counts = {
        "runs": len(states),
        "done": len(to_do) - len(sweep.errors),
        "cached": sum(state.state == CACHED for state in states),
        "failed": len(sweep.errors),
        "not_run": len(skipped),
        "left": sum(state.state == LEFT for state in states),
        "failed_beside": len(sweep.problems),
    }
    lines = [*problems, *sweep.problems]
    return {**counts, "digest": digest(table), "problems": lines, "out": str(out)}


def _open(experiment: Experiment, out: Path) -> None:
    """Make the folder, or accept that of the same experiment and change nothing in it."""
    files.check_output(out, may_resume=GRID_FILE)
    if (out / GRID_FILE).exists():
        continued(experiment, out)
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out {out} cannot be written: {error.strerror}; choose another folder."
        ) from None
    files.remove_partial(out, (GRID_FILE,))
    _store_table(experiment, out)


def _extend(experiment: Experiment, out: Path) -> None:
    """Store what is added to the folder's experiment; this call has claimed the folder."""
    if continued(experiment, out).table() != experiment.table():
        _store_table(experiment, out)


def continued(experiment: Experiment, out: Path) -> Experiment:
    """Return the experiment of the folder `out`, which is continued as `experiment`.

    Raises:
        OutputExists: it is another sweep's folder.
        BadFile: another version wrote it.
    """
    stored = read_experiment_of(out)
    if stored.kind != experiment.kind or not experiment.extends(stored.table()):
        raise OutputExists(
            f"--out {out} holds another sweep (see {out / GRID_FILE}); give another folder. "
            "Training seeds and conditions may be added to a plan; the rest must stay the same."
        )
    return stored


def _store_table(experiment: Experiment, out: Path) -> None:
    files.write_json(out / GRID_FILE, {"format": FORMAT, experiment.kind: experiment.table()})


@final
@dataclass(frozen=True)
class _Place:
    """Where a job's result is filed.

    Attributes:
        folder: its place.
        record: the file in it that names the job.
        state: the run it is the result of; None for what belongs to no run.
    """

    folder: Path
    record: str
    state: RunState | None = None

    def holds(self, key: str) -> bool:
        """Return True if the result of the job `key` is there."""
        path = self.folder / self.record
        return path.exists() and files.read_json(path).get("job") == key


@final
@dataclass
class _Sweep:
    """One call of a sweep.

    Attributes:
        experiment, out, context, attempts: as `run_sweep`'s.
        references: the untrained references to evaluate alongside the runs.
        device: as `run_sweep`'s.
        errors: run's key → what went wrong, in one line.
        problems: what went wrong outside the runs.
    """

    experiment: Experiment
    out: Path
    context: RunContext
    attempts: int
    references: tuple[RunConfig, ...]
    device: str | None = None
    errors: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    jobs: Jobs = field(init=False)
    _made: set[str] = field(default_factory=set)
    """Datasets made, or found whole, by this call."""

    def __post_init__(self) -> None:
        self._renew()

    def _renew(self) -> None:
        """Read the folder again: digests of datasets are parts of keys."""
        ours = {
            name: value for name, value in os.environ.items() if name.startswith("SURGICAI_VISION_")
        }
        self.jobs = Jobs(self.experiment, self.out, command_line(), ours, self.device)

    def prepare(self, to_do: Sequence[RunState]) -> None:
        """Make the datasets, features and policies that runs share.

        If a dataset fails, so do its runs. Those that need a learner come last: beside it the
        policies of the other datasets are trained.
        """
        users = {state.key: self.jobs.datasets_of(state.run) for state in to_do}
        replayed = [
            self.experiment.dataset_of(run)
            for run in self.references
            if run.policy == "replay" and not self._is_filed_reference(run)
        ]
        used = [name for state in to_do for name in users[state.key]]
        parts = [part for state in to_do for part in self.experiment.parts(state.run).values()]
        names = dict.fromkeys([*used, *replayed])
        for name in sorted(names, key=lambda name: name in self.experiment.learners):
            try:
                self._make_dataset(name, parts)
            except SurgicaiError as error:
                for state in to_do:
                    if name in users[state.key] and state.key not in self.errors:
                        self._fail(state, error)
        self._renew()
        live = [state for state in to_do if state.key not in self.errors]
        self._make_features(live)
        self._train_parts(live)

    def _make_dataset(self, name: str, parts: Sequence[Training]) -> None:
        """Make a dataset, and before it the policy that acts in its demonstrations, if one does.

        Args:
            name: the dataset's.
            parts: policies that are needed later; those that can be trained while the learner is
                use the processes that it leaves idle.

        Raises:
            SurgicaiError: the first thing that went wrong.
        """
        dataset = self.experiment.datasets[name]
        learner = None
        if name in self.experiment.learners:
            policy = self.experiment.learners[name]
            self._make_dataset(policy.dataset, parts)
            self._renew()  # the digest of what it is trained on is part of its key
            if not self._is_filed(policy):
                errors = self._train([policy, *self._beside(policy, parts)])
                if error := errors.get(self.jobs.policy(policy).key()):
                    raise error
            learner = learner_of(self.jobs.policy_folder(policy), dataset.env)
        make_dataset(dataset, self.jobs.data_folder(name), self.context, learner)
        self._made.add(name)

    def _beside(self, learner: Training, parts: Sequence[Training]) -> list[Training]:
        """Return the policies to train beside a learner, at most one for each idle process.

        Their datasets are made. Where policies share features, those are encoded first; such ones
        are trained later.
        """
        ready = [
            part
            for part in dict.fromkeys(parts)
            if part != learner
            and part.dataset in self._made
            and not part.encodes_all
            and not self._is_filed(part)
        ]
        return ready[: max(0, self.context.processes() - 1)]

    def _run(
        self,
        title: str,
        jobs: Sequence[Job],
        ended: Callable[[Job, Path, SurgicaiError | None], None],
    ) -> None:
        """Run jobs and show how many are done."""
        with self.context.stage(title, title) as progress:
            run_jobs(
                jobs,
                self.out / WORK,
                context=self.context,
                attempts=self.attempts,
                unit=title,
                progress=progress,
                ended=ended,
            )

    def _make_features(self, states: Sequence[RunState]) -> None:
        """Encode what runs see, each once.

        What fails here fails again in the run and is reported there.
        """
        jobs = {job.key(): job for state in states for job in self.jobs.features(state.run)}
        if jobs:
            self._run("features", list(jobs.values()), lambda job, folder, error: None)

    def _train_parts(self, states: Sequence[RunState]) -> None:
        """Train the policies that runs share and file them; a run that lacks one fails."""
        parts = {state.key: list(self.experiment.parts(state.run).values()) for state in states}
        errors = self._train([part for each in parts.values() for part in each])
        for state in states:
            for part in parts[state.key]:
                error = errors.get(self.jobs.policy(part).key())
                if error and state.key not in self.errors:
                    self._fail(state, error)

    def _train(self, policies: Iterable[Training]) -> dict[str, SurgicaiError]:
        """Train policies that are not there yet and file them; return the errors by job's key."""
        errors: dict[str, SurgicaiError] = {}
        placed = [(self.jobs.policy(policy), self._policy_place(policy)) for policy in policies]
        self._do_and_file("policies", placed, lambda job, place, error: errors.update({job: error}))
        return errors

    def do(self, to_do: Sequence[RunState]) -> None:
        """Do the runs and the references, and file each as it ends.

        Where there are fewer than processes, each run's episodes are shared among several.
        """
        live = [state for state in to_do if state.key not in self.errors]
        references = sum(not self._is_filed_reference(run) for run in self.references)
        each = self.context.processes_each(len(live) + references)
        placed = [
            (
                self.jobs.run(state.run, each),
                _Place(run_folder(self.out, state.key), RESULT_FILE, state),
            )
            for state in live
        ]
        placed += [
            (self.jobs.reference(run), self._reference_place(run)) for run in self.references
        ]

        def failed(job: str, place: _Place, error: SurgicaiError) -> None:
            if place.state:
                self._fail(place.state, error)
            else:
                self._note(place.folder.name, error)

        self._do_and_file("runs", placed, failed)

    def probe(self, runs: Sequence[RunConfig]) -> None:
        """Probe what the runs see, if the grid requests it."""
        wanted = self.jobs.probes(runs) if self.experiment.probe else {}
        placed = [
            (job, _Place(self.out / "probes" / name, PROBE_FILE)) for name, job in wanted.items()
        ]
        self._do_and_file(
            "probes",
            placed,
            lambda job, place, error: self._note(f"probe {place.folder.name}", error),
        )

    def _do_and_file(
        self,
        title: str,
        placed: Iterable[tuple[Job, _Place]],
        failed: Callable[[str, _Place, SurgicaiError], None],
    ) -> None:
        """Do the jobs that are not done yet, each once, and file each as it ends.

        Args:
            title: what the progress display calls them.
            placed: each job and where its result is filed.
            failed: called with the key and the place of each job that failed, as it ends.
        """
        by_key = {job.key(): (job, place) for job, place in placed}
        left = []
        for key, (job, place) in by_key.items():
            if (self.out / WORK / key).is_dir():  # finished by a call that was killed
                _file(self.out / WORK / key, place, key)
            if not place.holds(key):
                left.append(job)

        def ended(job: Job, folder: Path, error: SurgicaiError | None) -> None:
            key = folder.name
            _, place = by_key[key]
            if error is None:
                _file(folder, place, key)
            else:
                failed(key, place, error)

        if left:
            self._run(title, left, ended)

    def _is_filed(self, policy: Training) -> bool:
        return self._policy_place(policy).holds(self.jobs.policy(policy).key())

    def _policy_place(self, policy: Training) -> _Place:
        return _Place(self.jobs.policy_folder(policy), JOB_FILE)

    def _is_filed_reference(self, run: RunConfig) -> bool:
        return self._reference_place(run).holds(self.jobs.reference(run).key())

    def _reference_place(self, run: RunConfig) -> _Place:
        parts = [run.policy, run.task, *([run.condition] if run.condition else [])]
        return _Place(self.out / "references" / "-".join(parts), REFERENCE_FILE)

    def _note(self, what: str, error: SurgicaiError) -> None:
        """Note what went wrong outside the runs, in one line."""
        self.problems.append(f"failed: {what}: {' '.join(str(error).split())}")

    def _fail(self, state: RunState, error: SurgicaiError) -> None:
        """Store a run's error, with the traceback where it was none of ours.

        A result of other code or other data is removed: it is no longer valid.
        """
        folder = run_folder(self.out, state.key)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / RESULT_FILE).unlink(missing_ok=True)  # first: without it nothing is counted
        shutil.rmtree(folder / EVALUATION, ignore_errors=True)
        details = "\n".join([str(error), *getattr(error, "__notes__", [])])
        failed = {"format": FORMAT, "run": to_mapping(state.run), "error": details}
        files.write_json(folder / FAILED_FILE, failed)
        self.errors[state.key] = " ".join(str(error).split())


def _file(folder: Path, place: _Place, key: str) -> None:
    """Move a job's result to its place, its key in the record; what was there is replaced."""
    path = folder / place.record
    files.write_json(path, {**(files.read_json(path) if path.exists() else {}), "job": key})
    place.folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(place.folder, ignore_errors=True)
    os.rename(folder, place.folder)
    files.sync_folder(place.folder.parent)
    # Filed, so what a killed job would continue from is no longer needed.
    shutil.rmtree(folder.parent.parent / UNFINISHED / key, ignore_errors=True)
