"""Jobs of a sweep, as workers do them.

Encode, train a policy that runs share, do a run, evaluate a reference. Each writes into its own
folder and reads datasets and cache by path. Nothing here depends on which worker does it.

A run works in `scratch`, a folder that no other job uses, and continues there if a killed sweep is
run again: its training from the last state, its evaluation with the episodes that are missing. What
they make is then copied to the job's own folder. The sweep removes `scratch` once the result is
filed. A training by `lerobot-train` begins anew.
"""

import dataclasses
import functools
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, from_mapping
from surgicai_vision.core.files import write_json
from surgicai_vision.core.progress import Stage, silent_stage, timed
from surgicai_vision.dataset import Dataset, RenderedDataset, open_dataset
from surgicai_vision.dataset.subset import of_subtask
from surgicai_vision.detection.card import RELEASED
from surgicai_vision.evaluation.aimed_agent import aimed
from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig
from surgicai_vision.evaluation.policy_spec import (
    PolicySpec,
    hierarchical_policy,
    in_env,
    open_policy,
)
from surgicai_vision.evaluation.robustness.axes import shifted
from surgicai_vision.evaluation.run import evaluate_into
from surgicai_vision.evaluation.storage import RESULT_FILE
from surgicai_vision.experiments.run import encode_run, train_run
from surgicai_vision.experiments.sweep.collect import EVALUATION
from surgicai_vision.experiments.sweep.lerobot import SCRATCH, train_lerobot
from surgicai_vision.experiments.sweep.plan import PROBE_FILE, REFERENCE_FILE
from surgicai_vision.features.devices import AUTO
from surgicai_vision.features.encoders import WeightsSource
from surgicai_vision.features.probe import probe
from surgicai_vision.training.run_config import RunConfig, evaluated_in

type Table = Mapping[str, JSON]

POLICY = "policy"
"""Folder of a checkpoint within a run's, and within the folder in which a run works."""


def encode_features(
    folder: Path,
    run: Table,
    dataset: str,
    accept_licence: bool,
    device: str | None,
    command: str,
    environment: Mapping[str, str],
) -> None:
    """Job "sweep-features": put what a run sees into the feature cache."""
    os.environ.update(environment)
    weights = WeightsSource(accept_licence=accept_licence)
    features = encode_run(_run(run), _dataset(dataset), silent_stage, weights, device or AUTO)
    write_json(folder / "features.json", [entry.folder.name for entry in features])


def train_policy(
    folder: Path,
    run: Table,
    subtask: str | None,
    encodes_all: bool,
    demos: Sequence[str],
    scratch: str,
    dataset: str,
    accept_licence: bool,
    device: str | None,
    command: str,
    environment: Mapping[str, str],
) -> None:
    """Job "sweep-policy": train a policy that runs share."""
    os.environ.update(environment)
    weights = WeightsSource(accept_licence=accept_licence)
    data: Dataset = _dataset(dataset)
    if subtask and not encodes_all:
        data = of_subtask(data, subtask)
        subtask = None
    trained = Path(scratch) / POLICY
    train_run(
        _run(run),
        data,
        trained,
        silent_stage,
        weights,
        subtask=subtask,
        demos=[Path(one) for one in demos],
        device=device,
    )
    shutil.copytree(trained, folder, dirs_exist_ok=True)


def train_and_evaluate(
    folder: Path,
    run: Table,
    final: str,
    policies: Mapping[str, str],
    env: Table,
    procedure: Table,
    processes: int,
    scratch: str,
    dataset: str,
    accept_licence: bool,
    device: str | None,
    command: str,
    environment: Mapping[str, str],
) -> None:
    """Job "sweep-run": train a policy, or take those made before, and evaluate it.

    The episodes run in `processes` processes.
    """
    os.environ.update(environment)
    what = _run(run)
    weights = WeightsSource(accept_licence=accept_licence)
    seconds: dict[str, float] = {}
    with timed(silent_stage, seconds) as measured:
        about: dict[str, JSON] = {"command": command}
        if what.is_hierarchical:
            table = {**dict.fromkeys(names.SUBTASKS, "expert"), **policies, **procedure}
            config = from_mapping(HierarchicalConfig, table, "procedure")
            spec = hierarchical_policy(config, weights=weights)
        elif policies:
            spec = open_policy(*policies.values(), task=what.task, weights=weights)
        else:
            policy = folder / POLICY
            _train(what, _dataset(dataset), policy, Path(scratch), measured, weights, device)
            spec = open_policy(policy, task=what.task, weights=weights)
            about["folder"] = str(Path(final) / POLICY)
        spec = in_env(spec, env)
        if what.detector:
            spec = aimed(spec, RELEASED)
        spec = _shifted(spec, what)
        about = {**spec.about, **about}
        with measured("evaluation", "steps"):
            summary = evaluate_run(folder, Path(scratch), spec, what, about, processes)
    shutil.rmtree(folder / SCRATCH, ignore_errors=True)
    write_json(folder / RESULT_FILE, {"run": run, "summary": summary, "seconds": seconds})


def evaluate_reference(
    folder: Path, run: Table, dataset: str, command: str, environment: Mapping[str, str]
) -> None:
    """Job "sweep-reference": evaluate an untrained reference."""
    os.environ.update(environment)
    what = _run(run)
    demonstrated = _dataset(dataset) if what.policy == "replay" else None
    spec = open_policy(what.policy, task=what.task, dataset=demonstrated)
    spec = dataclasses.replace(spec, run=dataclasses.replace(spec.run, env=what.env))
    spec = _shifted(spec, what)
    summary = evaluate_as(folder, spec, what, {**spec.about, "command": command})
    write_json(folder / REFERENCE_FILE, {"summary": summary})


def run_probe(
    folder: Path,
    run: Table,
    dataset: str,
    accept_licence: bool,
    device: str | None,
    command: str,
    environment: Mapping[str, str],
) -> None:
    """Job "sweep-probe": measure how well what a run sees predicts the needle's pose."""
    os.environ.update(environment)
    what = _run(run)
    data = _dataset(dataset)
    weights = WeightsSource(accept_licence=accept_licence)
    features = encode_run(what, data, silent_stage, weights, device or AUTO)
    row = {
        "task": what.task,
        "encoder": what.encoder,
        "view": "+".join(what.views),
        "pool": what.pool,
    }
    write_json(folder / PROBE_FILE, {**row, **probe(data, features).row()})


def _train(
    run: RunConfig,
    dataset: RenderedDataset,
    policy: Path,
    scratch: Path,
    stage: Stage,
    weights: WeightsSource,
    device: str | None,
) -> None:
    """Train a run's policy into the folder `policy`, or continue its training in `scratch`."""
    if run.by_lerobot_train:
        with stage("policy", "steps"):
            train_lerobot(run, dataset, policy, weights, device)
    else:
        train_run(run, dataset, scratch / POLICY, stage, weights, device=device)
        shutil.copytree(scratch / POLICY, policy)


def evaluate_run(
    folder: Path, scratch: Path, spec: PolicySpec, run: RunConfig, about: Table, processes: int
) -> dict[str, JSON]:
    """Evaluate a run in `scratch`, or continue there, and copy the evaluation into its folder."""
    summary = evaluate_as(scratch / EVALUATION, spec, run, about, processes)
    shutil.copytree(scratch / EVALUATION, folder / EVALUATION)
    return summary


def evaluate_as(
    folder: Path, spec: PolicySpec, run: RunConfig, about: Table, processes: int = 1
) -> dict[str, JSON]:
    """Evaluate `spec` in its env, named and stored as `run`, in `processes` processes.

    What is stored says if a policy within `spec`, such as an expert, sees the state with the goal.
    """
    assert run.starts is not None, "the experiment says where a run is evaluated"
    stored = evaluated_in(run, spec.config, run.shift)
    if spec.run.sees_goal and not stored.sees_goal:
        stored = dataclasses.replace(stored, privileged=True)
    spec = dataclasses.replace(spec, run=stored, about=about)
    return evaluate_into(folder, spec, run.starts.seeds, workers=processes)


def _shifted(spec: PolicySpec, run: RunConfig) -> PolicySpec:
    """Return a policy under the shift of its run, if there is one."""
    return shifted(spec, run.shift.axis, run.shift.strength) if run.shift else spec


def _run(table: Table) -> RunConfig:
    return from_mapping(RunConfig, table, "run")


@functools.lru_cache(maxsize=1)
def _dataset(folder: str) -> RenderedDataset:
    """Open a dataset, or take the one this process read last: its fingerprint is computed once."""
    return open_dataset(Path(folder))
