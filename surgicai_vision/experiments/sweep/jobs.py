"""Jobs of a sweep, as workers do them: encode, train a chain's policy, do a cell, evaluate a
reference.

Each writes into its own folder and reads datasets and cache by path. Nothing here depends on who
does it.
"""

import dataclasses
import functools
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.files import write_json
from surgicai_vision.core.progress import Stage, silent_stage, timed
from surgicai_vision.dataset import RenderedDataset, open_dataset
from surgicai_vision.evaluation.policy_spec import (
    Subject,
    baseline_subject,
    checkpoint_subject,
    replay_subject,
)
from surgicai_vision.evaluation.run import evaluate_into
from surgicai_vision.evaluation.storage import CELL_FILE
from surgicai_vision.experiments.run import Cell, encode_cell, train_cell
from surgicai_vision.experiments.sweep.lerobot import LEROBOT_POLICIES, SCRATCH, train_lerobot
from surgicai_vision.experiments.sweep.plan import PROBE_FILE, REFERENCE_FILE
from surgicai_vision.features.encoders import WeightsSource

Table = Mapping[str, Any]


def encode_features(
    folder: Path,
    cell: Table,
    dataset: str,
    accept_licence: bool,
    options: Table,
    command: str,
    environment: Table,
) -> None:
    """Job "sweep-features": put what a cell sees into the feature cache."""
    os.environ.update(environment)
    features = encode_cell(
        _cell(cell), _dataset(dataset), silent_stage, WeightsSource(accept_licence=accept_licence)
    )
    write_json(folder / "features.json", [entry.folder.name for entry in features])


def train_policy(
    folder: Path,
    cell: Table,
    dataset: str,
    accept_licence: bool,
    options: Table,
    command: str,
    environment: Table,
) -> None:
    """Job "sweep-policy": train one policy of a chain."""
    os.environ.update(environment)
    train_cell(
        _cell(cell),
        _dataset(dataset),
        folder,
        silent_stage,
        weights=WeightsSource(accept_licence=accept_licence),
        **options,
    )


def run_cell(
    folder: Path,
    cell: Table,
    seeds: Sequence[int],
    final: str,
    policies: Mapping[str, str],
    dataset: str,
    accept_licence: bool,
    options: Table,
    command: str,
    environment: Table,
) -> None:
    """Job "sweep-cell": train a cell's policy, or take a chain's, and count its successes on
    held-out starts.
    """
    os.environ.update(environment)
    what, seconds, policy = _cell(cell), dict[str, float](), folder / "policy"
    stage = functools.partial(timed, silent_stage, seconds)
    with stage() as measured:
        subject = _subject(
            what,
            policies,
            _dataset(dataset),
            policy,
            measured,
            WeightsSource(accept_licence=accept_licence),
            options,
        )
        about = {
            **subject.about,
            "command": command,
            "folder": str(Path(final) / "policy"),
            "swap": what.swap,
        }
        with measured("evaluation", "steps"):
            summary = _evaluate(
                folder / "evaluation", dataclasses.replace(subject, about=about), seeds
            )
    shutil.rmtree(folder / SCRATCH, ignore_errors=True)
    write_json(folder / CELL_FILE, {"cell": cell, "summary": summary, "seconds": seconds})


def run_reference(
    folder: Path,
    name: str,
    config: Table,
    seeds: Sequence[int],
    dataset: str,
    command: str,
    environment: Table,
) -> None:
    """Job "sweep-reference": evaluate who was not trained."""
    os.environ.update(environment)
    replay = name == "replay"
    subject = (
        replay_subject(_dataset(dataset))
        if replay
        else baseline_subject(name, from_mapping(TaskConfig, config))
    )
    about = {**subject.about, "command": command}
    summary = _evaluate(folder, dataclasses.replace(subject, about=about), seeds)
    write_json(folder / REFERENCE_FILE, {"summary": summary})


def run_probe(
    folder: Path,
    cell: Table,
    dataset: str,
    accept_licence: bool,
    options: Table,
    command: str,
    environment: Table,
) -> None:
    """Job "sweep-probe": say what of the needle's pose can be read from what a cell sees."""
    from surgicai_vision.features.probe import probe

    os.environ.update(environment)
    what, data = _cell(cell), _dataset(dataset)
    features = encode_cell(what, data, silent_stage, WeightsSource(accept_licence=accept_licence))
    row = {
        "task": what.task,
        "encoder": what.encoder,
        "view": "+".join(what.view),
        "pool": what.pool,
    }
    write_json(folder / PROBE_FILE, {**row, **probe(data, features).row()})


def _subject(
    cell: Cell,
    policies: Mapping[str, str],
    dataset: RenderedDataset,
    policy: Path,
    stage: Stage,
    weights: WeightsSource,
    options: Table,
) -> Subject:
    """Return who acts in a cell; trained here unless it is a chain."""
    if cell.chain:
        return _chain(cell, policies, weights)
    if cell.policy in LEROBOT_POLICIES:
        from surgicai_vision.evaluation import lerobot_agent

        with stage("policy", "steps"):
            train_lerobot(cell, dataset, policy, weights=weights, **options)
        where = lerobot_agent.find(policy)
        assert where is not None, "lerobot-train ended well and left no checkpoint"
        return lerobot_agent.subject(where, cell.task, weights)
    train_cell(cell, dataset, policy, stage, weights)
    return checkpoint_subject(policy, weights)


def _chain(cell: Cell, policies: Mapping[str, str], weights: WeightsSource) -> Subject:
    """Return the subject of a chain, named by what it is and not by where its policies lie."""
    from surgicai_vision.evaluation import hierarchical

    low = {subtask: policies.get(subtask, "expert") for subtask in names.SUBTASKS}
    made = from_mapping(
        hierarchical.Chain, {"hlp": policies["hlp"], **low, "termination": cell.chain}
    )
    subject = hierarchical.subject(made, weights)
    make = functools.partial(hierarchical.ChainAgent, cell.name, made, weights)
    about = {**subject.about, "encoder": cell.encoder}
    return dataclasses.replace(subject, name=cell.name, make_agent=make, about=about)


def _evaluate(folder: Path, subject: Subject, seeds: Sequence[int]) -> dict[str, Any]:
    """Evaluate on the starts from the first of `seeds` to the one before the second."""
    return evaluate_into(folder, subject, range(*seeds), workers=1)


def _cell(table: Table) -> Cell:
    return from_mapping(Cell, table, "cell")


@functools.lru_cache(maxsize=1)
def _dataset(folder: str) -> RenderedDataset:
    """Open a dataset, or take the one this process read last: its fingerprint is computed once."""
    return open_dataset(Path(folder))
