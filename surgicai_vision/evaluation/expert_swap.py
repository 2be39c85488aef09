"""Survival: how far episodes of a chain come, and how far they would with the expert in the place
of one policy.

`swapped(subject, …)` is a chain with the expert in for one subtask; `survival_curves` evaluates the
chain as it is and with every subtask swapped in turn, on the same starts, one evaluation folder
each, and writes `survival.parquet`: for every variant and subtask the episodes that finished it and
all before it.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surgicai_vision.core import files, names
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import check_name
from surgicai_vision.core.progress import Stage
from surgicai_vision.evaluation import hierarchical
from surgicai_vision.evaluation.agent import Agent, MakeAgent
from surgicai_vision.evaluation.policy_spec import Subject
from surgicai_vision.evaluation.run import evaluate_into
from surgicai_vision.evaluation.statistics import clopper_pearson, holm, mcnemar
from surgicai_vision.evaluation.storage import MARKER, parquet_bytes, read_rows
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource

CURVES, MARK = "survival.parquet", "survival.json"
EXPERT, ALL, AS_IT_IS = "expert", "all", "as-it-is"


def swapped(
    config: hierarchical.Chain,
    subtask: str | None,
    weights: WeightsSource = ANYWHERE,
) -> Subject:
    """Return the subject of a chain with the expert in the place of one subtask's policy.

    It keeps the chain's name; `about["swap"]` tells it from the chain.

    Args:
        config: the chain.
        subtask: one of `names.SUBTASKS`, or None for the chain as it is.
        weights: where pretrained weights come from.
    """
    plain = hierarchical.subject(config, weights)
    if subtask is None:
        return dataclasses.replace(plain, about={**plain.about, "swap": None})
    check_name("subtask", subtask, names.SUBTASKS)
    change: dict[str, Any] = {subtask: EXPERT}
    other = hierarchical.subject(dataclasses.replace(config, **change), weights)
    make = functools.partial(_named, other.make_agent, plain.name)
    # With experts in every place a chain knows no scene; the task stays that of the chain as it is.
    about = {**other.about, "swap": subtask}
    return dataclasses.replace(
        other, name=plain.name, config=plain.config, make_agent=make, about=about
    )


def _named(make: MakeAgent, name: str) -> Agent:
    """Make an agent under another name (in a worker process)."""
    agent = make()
    agent.name = name
    return agent


def survival_curves(
    variants: dict[str, Subject],
    seeds: Sequence[int],
    out: Path,
    stage: Stage,
    workers: int | None = None,
) -> list[dict[str, Any]]:
    """Evaluate a chain as it is and swapped into `out`, and return the rows of `survival.parquet`.

    What is there already is kept, so running again continues.

    Args:
        variants: folder name → subject, from `variants_of`; the first is the chain as it is.
        seeds: start seeds, the same for all.
        out: folder to make or to continue.
        stage: shows progress.
        workers: processes.

    Raises:
        OutputExists: `out` holds the curves of another chain or of other starts.
    """
    plain = variants[AS_IT_IS]
    _claim(out, plain, seeds)
    successes, rows = {}, []
    for name, subject in variants.items():
        folder = out / name
        if not (folder / MARKER).exists():
            with stage(f"{name}: {subject.name}", "steps") as progress:
                evaluate_into(folder, subject, seeds, workers, progress)
        episodes = read_rows(folder)
        successes[name] = [bool(row["success"]) for row in episodes]
        rows += _stages(str(subject.about["swap"] or ""), [row["stages"] for row in episodes])
    others = [name for name in variants if name != AS_IT_IS]
    p_values = [mcnemar(successes[AS_IT_IS], successes[name]) for name in others]
    found = {
        name: (p, corrected)
        for name, p, corrected in zip(others, p_values, holm(p_values), strict=True)
    }
    for row in rows:
        row["p"], row["p_holm"] = found.get(row["swap"], (None, None))
    files.write_bytes(out / CURVES, parquet_bytes(rows))
    return rows


def variants_of(
    config: hierarchical.Chain, weights: WeightsSource = ANYWHERE
) -> dict[str, Subject]:
    """Return folder name → subject: the chain as it is, then each subtask that is not the expert's
    already swapped.
    """
    learned = [subtask for subtask in names.SUBTASKS if getattr(config, subtask) != EXPERT]
    swaps = {subtask: swapped(config, subtask, weights) for subtask in learned}
    return {AS_IT_IS: swapped(config, None, weights), **swaps}


def _stages(swap: str, stages: Sequence[int]) -> list[dict[str, Any]]:
    """Return how many episodes finished each subtask and all before it."""
    rows = []
    for index, subtask in enumerate(names.SUBTASKS):
        k, n = sum(stage > index for stage in stages), len(stages)
        low, high = clopper_pearson(k, n)
        rows.append(
            {
                "swap": swap,
                "stage": index + 1,
                "subtask": subtask,
                "k": k,
                "n": n,
                "low": low,
                "high": high,
            }
        )
    return rows


def _claim(out: Path, subject: Subject, seeds: Sequence[int]) -> None:
    """Write which chain is evaluated where into `out`, or refuse a folder of another one."""
    mine = {
        "chain": subject.about["chain"],
        "task_config": to_mapping(subject.config),
        "seeds": [int(seed) for seed in seeds],
    }
    files.claim(out / MARK, mine, "the survival")
