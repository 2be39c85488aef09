"""Tables: the page's numbers as Markdown, LaTeX (booktabs), CSV and Parquet.

`table.*` have one row per condition, `cells.parquet` one per cell (a training seed), including
those without a result, `pairs.csv` one per comparison, and `dependence.csv` one per condition,
quantity that was drawn and part of the starts. `algorithms.md`, written if actors were evaluated,
has our numbers next to those of the paper's tables 1 and 4.
"""

import csv
import io
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from surgicai_vision.core import files
from surgicai_vision.evaluation import statistics
from surgicai_vision.evaluation.metrics import KINDS
from surgicai_vision.evaluation.storage import parquet_bytes
from surgicai_vision.report import text
from surgicai_vision.report.dependence import Dependence, records
from surgicai_vision.report.experiment_key import Condition
from surgicai_vision.report.formats import latex, markdown
from surgicai_vision.report.groups import MEASURES, Group, measured
from surgicai_vision.report.pairs import Pair
from surgicai_vision.report.paper_comparison import paper_rate
from surgicai_vision.report.reader import REFERENCES, Result
from surgicai_vision.report.reinforcement import learned
from surgicai_vision.report.reinforcement import markdown as learned_markdown

FOLDER = "tables"


def write_tables(
    folder: Path,
    groups: Sequence[Group],
    pairs: Sequence[Pair],
    dependences: Sequence[Dependence],
    title: str,
) -> Path:
    """Write every table below `folder` and return their folder."""
    out = folder / FOLDER
    out.mkdir(parents=True, exist_ok=True)
    contents = {
        "table.md": markdown(groups, title).encode(),
        "table.tex": latex(groups, title).encode(),
        "table.csv": _csv([condition_record(item) for item in groups]),
        "cells.parquet": parquet_bytes(_filled(list(cell_records(groups)))),
        "pairs.csv": _csv([_pair_record(pair) for pair in pairs]),
        "dependence.csv": _csv(records(dependences)),
    }
    found = learned(groups)
    if found:
        contents["algorithms.md"] = learned_markdown(found).encode()
    for name, content in contents.items():
        write_changed(out / name, content)
    return out


def write_changed(path: Path, content: bytes) -> None:
    """Write a file unless it already has that content: a second run changes nothing."""
    if not path.exists() or path.read_bytes() != content:
        files.write_bytes(path, content)


def condition_record(item: Group) -> dict[str, object]:
    """Return one condition as a flat row with numbers."""
    evaluated = item.episodes > 0
    low, high = item.interval if evaluated else (None, None)
    across = item.across
    reference = paper_rate(item.condition)
    row = {
        **_identity(item.condition),
        "training_seeds": len(item.results),
        "cells_missing": len(item.missing),
        "successes": item.successes if evaluated else None,
        "episodes": item.episodes,
        "paper_successes": item.paper_successes if evaluated else None,
        "rate": item.rate if evaluated else None,
        "low": low,
        "high": high,
        "mean_over_seeds": across.mean if across else None,
        "std_over_seeds": across.std if across else None,
        "bootstrap_low": across.interval[0] if across else None,
        "bootstrap_high": across.interval[1] if across else None,
        "paper_rate": reference,
    }
    return {
        **row,
        **_measures(item.rows),
        "missing": "; ".join(f"{c.state}: {c.reason}" for c in item.missing),
    }


def cell_records(groups: Sequence[Group]) -> Iterator[dict[str, object]]:
    """Yield one flat row per cell.

    It says what the cell is, its counts and measures and how to reproduce them, or why it has no
    result.
    """
    for item in groups:
        for result in item.results:
            k = sum(bool(row["success"]) for row in result.rows)
            n = len(result.rows)
            low, high = statistics.clopper_pearson(k, n)
            checkpoint = result.checkpoint
            yield {
                **_identity(item.condition),
                "training_seed": result.seed if result.trained else None,
                "state": "done",
                "reason": "",
                "successes": k,
                "episodes": n,
                "rate": k / n,
                "low": low,
                "high": high,
                "paper_rate": paper_rate(item.condition),
                **_measures(result.rows),
                "first_start": min(row["seed"] for row in result.rows),
                "dataset": checkpoint.get("dataset"),
                "weights_sha256": checkpoint.get("weights_sha256"),
                "policy_sha256": checkpoint.get("policy_sha256"),
                "scene_hash": result.about.get("scene_hash"),
                "command": result.about.get("command"),
                "evaluate": evaluate_command(result),
            }
        for cell in item.missing:
            row = {
                **_identity(item.condition),
                "training_seed": cell.seed,
                "state": cell.state,
                "reason": cell.reason,
            }
            yield {**row, "episodes": 0, "paper_rate": paper_rate(item.condition)}


def evaluate_command(result: Result) -> str | None:
    """Return the command that evaluates a cell's stored policy again, if one line can.

    An option alone sets neither the env nor how a policy acts, so both must be the policy's own.
    """
    about = result.about
    seeds = [row["seed"] for row in result.rows]
    whole = seeds == list(range(seeds[0], seeds[0] + len(seeds)))
    condition = result.condition
    if not whole or not condition.plain or condition.name or result.run.is_hierarchical:
        return None
    if result.run.acted_by or result.config != result.own_env:
        return None
    ending = f"--task {result.summary['task']} --episodes {len(seeds)} --seed {seeds[0]} --json"
    if result.run.detector:
        ending = f"--detector {shlex.quote(str(about['detector']))} {ending}"
    name = result.summary["policy"]
    if about.get("folder"):
        return f"surgicai-vision evaluate {shlex.quote(str(about['folder']))} {ending}"
    return f"surgicai-vision evaluate {name} {ending}" if name in REFERENCES[:3] else None


def _filled(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Give every row every column: a table's columns are those of its first row."""
    columns = dict.fromkeys(name for row in sorted(rows, key=len, reverse=True) for name in row)
    return [{name: row.get(name) for name in columns} for row in rows]


def _identity(condition: Condition) -> dict[str, object]:
    return {
        "task": condition.task,
        "encoder": condition.encoder,
        "views": "+".join(condition.views),
        "variant": condition.variant,
        "demonstrations": condition.demonstrations,
        "demonstrator": condition.demonstrator or None,
        "noise": condition.noise,
        "budget": condition.budget or None,
        "shift": condition.axis,
        "strength": condition.strength,
        "expert_in": condition.expert_swap,
        "upset": condition.upset,
        "condition": condition.name,
        "trained": condition.trained,
    }


def _measures(rows: Sequence[Mapping[str, Any]]) -> dict[str, object]:
    """Return means over successes, medians of what was measured, and failures by kind."""
    wins = [row for row in rows if row["success"]]
    found: dict[str, object] = {}
    for column in ("trajectory_length_mm", "steps"):
        spread = statistics.mean_and_std([float(row[column]) for row in wins])
        found |= {f"{column}_mean": spread["mean"], f"{column}_std": spread["std"]}
    for column, *_ in MEASURES:
        middle = text.quartiles([measured(row, column) for row in rows])
        found[f"{column}_median"] = middle[1] if middle else None
    failures = [row["failure"] for row in rows if not row["success"]]
    return {**found, **{kind: failures.count(kind) for kind in KINDS}}


def _pair_record(pair: Pair) -> dict[str, object]:
    return {
        "task": pair.first.condition.task,
        "differ_in": pair.factor,
        "first": pair.first.label,
        "second": pair.second.label,
        "paired_episodes": pair.episodes,
        "first_only": pair.first_only,
        "second_only": pair.second_only,
        "mcnemar_p": pair.p,
        "holm_p": pair.adjusted,
    }


def _csv(rows: Sequence[Mapping[str, object]]) -> bytes:
    out = io.StringIO()
    if rows:
        writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return out.getvalue().encode()
