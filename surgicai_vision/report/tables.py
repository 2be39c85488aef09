"""Tables: the page's numbers as Markdown, LaTeX (booktabs), CSV and Parquet.

`table.*` have one row a condition; `cells.parquet` one a cell (a training seed), those without a result too;
`pairs.csv` one a comparison.
"""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from surgicai_vision import files, names, statistics
from surgicai_vision.report import paper, text
from surgicai_vision.report.groups import KINDS, MEASURES, Group, measured
from surgicai_vision.report.pairs import Pair
from surgicai_vision.report.reading import REFERENCES, Condition, Result
from surgicai_vision.results import parquet_bytes

FOLDER = "tables"
HEAD = ("task", "policy", "views", "k/n", "success", "95 % interval", "across training seeds", "length [mm]", "steps")

_TELLING = tuple(name for name in paper.ENCODERS if name != "random")
_DEMONSTRATIONS = 50
"""Of each subtask, in the released code."""

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--", "±": r"$\pm$", "·": r"$\cdot$", "×": r"$\times$",
    "°": r"$^\circ$", "<": "$<$", ">": "$>$",
}  # fmt: skip


def write_tables(folder: Path, groups: Sequence[Group], pairs: Sequence[Pair], title: str) -> Path:
    """Write every table below `folder` and return their folder."""
    out = folder / FOLDER
    out.mkdir(parents=True, exist_ok=True)
    contents = {
        "table.md": markdown(groups, title).encode(),
        "table.tex": latex(groups, title).encode(),
        "table.csv": _csv([condition_record(item) for item in groups]),
        "cells.parquet": parquet_bytes(list(cell_records(groups))),
        "pairs.csv": _csv([_pair_record(pair) for pair in pairs]),
    }
    for name, content in contents.items():
        path = out / name
        if not path.exists() or path.read_bytes() != content:  # a second run changes nothing
            files.write_bytes(path, content)
    return out


def beside_paper(groups: Sequence[Group]) -> list[tuple[str, str, list[tuple[float | None, Group | None]]]]:
    """Return the paper's Table 2 and ours as rows (task, encoder, [(paper's rate, our condition) for each view]).

    The paper's encoders come first in each task, then ours that it has not. Rates are None where the paper has none.
    Empty without a pretrained encoder of the paper's. Of several numbers of demonstrations the one nearest to the
    paper's is taken.
    """
    known = [item for item in groups if _comparable(item.condition)]
    if not any(item.condition.encoder in _TELLING for item in known):
        return []
    known.sort(key=lambda item: -abs((item.condition.demonstrations or 0) - _DEMONSTRATIONS))
    ours = {(c.task, c.encoder, c.view): item for item in known if (c := item.condition)}
    tasks = [task for task in names.TASKS if any(task == mine for mine, _, _ in ours)]
    others = sorted({encoder for _, encoder, _ in ours} - set(paper.ENCODERS))
    rows = []
    for task in tasks:
        for encoder in (*paper.ENCODERS, *others):
            in_paper = paper.has(task, encoder)
            pairs = [
                (paper.rate(task, encoder, view) if in_paper else None, ours.get((task, encoder, view)))
                for view in paper.VIEWS
            ]
            if any(rate is not None or item is not None for rate, item in pairs):
                rows.append((task, encoder, pairs))
    return rows


def paper_text(task: str, encoder: str, rate: float | None) -> str:
    """Return the paper's rate as text, or why there is none."""
    if rate is not None:
        return text.percent(rate)
    return "not reported" if paper.has(task, encoder) else "not in the paper"


def our_text(item: Group | None) -> str:
    """Return our count and interval, or why there is none."""
    if item is None:
        return "not in this sweep"
    if item.episodes:
        return f"{item.successes}/{item.episodes} ({text.interval(item.interval)})"
    return item.missing[0].state


def markdown(groups: Sequence[Group], title: str) -> str:
    """Return the tables as Markdown."""
    parts = [f"# {_escaped(title)}", ""]
    rows = beside_paper(groups)
    if rows:
        parts += [f"Success beside the paper's ({paper.SOURCE}); ours: k/n and exact 95 % interval.", ""]
        parts += _markdown(("task", "encoder", "front, paper", "front, ours", "back, paper", "back, ours"), [
            (task, encoder, *_paired(task, encoder, pairs)) for task, encoder, pairs in rows
        ])  # fmt: skip
    parts += [f"Success from held-out starts. {CAPTION}", "", *_markdown(HEAD, [_record(item) for item in groups])]
    missing = [cell for item in groups for cell in item.missing]
    if missing:
        lines = [(c.condition.task, c.condition.label, str(c.seed), c.state, c.reason) for c in missing]
        parts += ["Cells without a result.", ""]
        parts += _markdown(("task", "policy", "training seed", "state", "reason"), lines)
    return "\n".join(parts).rstrip() + "\n"


CAPTION = (
    "Intervals: exact (Clopper-Pearson), 95 %, episodes of all training seeds together; across training seeds: mean, "
    "standard deviation and hierarchical bootstrap interval. Length and steps: mean and standard deviation over "
    "successful episodes."
)


def latex(groups: Sequence[Group], title: str) -> str:
    """Return the tables as LaTeX; the document needs the package booktabs and, for many rows, a smaller font."""
    parts = ["% needs \\usepackage{booktabs}"]
    rows = beside_paper(groups)
    if rows:
        body = [(task, encoder, *_paired(task, encoder, pairs)) for task, encoder, pairs in rows]
        spans = r"\multicolumn{2}{c}{front} & \multicolumn{2}{c}{back} \\"
        head = ["& & " + spans, r"\cmidrule(lr){3-4}\cmidrule(lr){5-6}"]
        head.append(_latex_row(("task", "encoder", "paper", "ours", "paper", "ours")))
        caption = f"Success rates beside those of {paper.SOURCE}; ours: k/n and exact 95 % interval."
        parts += _latex_table("llrrrr", head, body, caption, "tab:paper")
    body = [_record(item) for item in groups]
    parts += _latex_table("lllrrrrrr", [_latex_row(HEAD)], body, f"{title}. {CAPTION}", "tab:success")
    return "\n".join(parts) + "\n"


def escape_latex(words: str) -> str:
    """Escape what LaTeX reads as a command."""
    return "".join(_LATEX.get(letter, letter) for letter in words)


def condition_record(item: Group) -> dict[str, Any]:
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
        "rate": item.rate if evaluated else None,
        "low": low,
        "high": high,
        "mean_over_seeds": across.mean if across else None,
        "std_over_seeds": across.std if across else None,
        "bootstrap_low": across.interval[0] if across else None,
        "bootstrap_high": across.interval[1] if across else None,
        "paper_rate": reference,
    }
    return {**row, **_measures(item.rows), "missing": "; ".join(f"{c.state}: {c.reason}" for c in item.missing)}


def cell_records(groups: Sequence[Group]) -> Iterator[dict[str, Any]]:
    """Yield one flat row a cell: what it is, its counts and measures, how to make it again, or why there is none."""
    for item in groups:
        for result in item.results:
            k, n = result.summary["successes"], len(result.rows)
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
            row = {**_identity(item.condition), "training_seed": cell.seed, "state": cell.state, "reason": cell.reason}
            yield {**row, "episodes": 0, "paper_rate": paper_rate(item.condition)}


def evaluate_command(result: Result) -> str | None:
    """Return the command that counts a cell's successes again from its stored policy, where one line does."""
    about, seeds = result.about, [row["seed"] for row in result.rows]
    whole = seeds == list(range(seeds[0], seeds[0] + len(seeds)))
    if not whole or not result.condition.plain or about.get("chain") or about.get("rounds"):
        return None
    ending = f"--task {result.summary['task']} --episodes {len(seeds)} --seed {seeds[0]} --json"
    name = result.summary["policy"]
    if about.get("folder"):
        import shlex

        return f"surgicai-vision evaluate {shlex.quote(str(about['folder']))} {ending}"
    return f"surgicai-vision evaluate {name} {ending}" if name in REFERENCES[:3] else None


def paper_rate(condition: Condition) -> float | None:
    """Return the paper's rate of the same task, encoder and single view, or None."""
    if not _comparable(condition) or not paper.has(condition.task, condition.encoder):
        return None
    return paper.rate(condition.task, condition.encoder, condition.views[0])


def _comparable(condition: Condition) -> bool:
    """Whether it is what the paper's Table 2 holds: one view of the two, everything else as usual."""
    usual = condition.trained and condition.plain and not condition.variant
    return usual and len(condition.views) == 1 and condition.views[0] in paper.VIEWS


def _identity(condition: Condition) -> dict[str, Any]:
    return {
        "task": condition.task,
        "encoder": condition.encoder,
        "views": "+".join(condition.views),
        "variant": condition.variant,
        "demonstrations": condition.demonstrations,
        "shift": condition.axis,
        "strength": condition.strength,
        "expert_in": condition.swap,
        "trained": condition.trained,
    }


def _measures(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return means over successes, medians of what was measured, and failures by kind."""
    wins = [row for row in rows if row["success"]]
    found: dict[str, Any] = {}
    for column in ("trajectory_length_mm", "steps"):
        spread = statistics.mean_and_std([float(row[column]) for row in wins])
        found |= {f"{column}_mean": spread["mean"], f"{column}_std": spread["std"]}
    for column, *_ in MEASURES:
        middle = text.quartiles([measured(row, column) for row in rows])
        found[f"{column}_median"] = middle[1] if middle else None
    failures = [row["failure"] for row in rows if not row["success"]]
    return {**found, **{kind: failures.count(kind) for kind in KINDS}}


def _pair_record(pair: Pair) -> dict[str, Any]:
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


def _record(item: Group) -> tuple[str, ...]:
    start = (item.condition.task, _policy(item), item.condition.view or text.ABSENT)
    if not item.episodes:
        return (*start, item.missing[0].state, *[text.ABSENT] * 5)
    count = f"{item.successes}/{item.episodes}"
    spread = [text.mean(item.on_successes(column)) for column in ("trajectory_length_mm", "steps")]
    return (*start, count, text.percent(item.rate), text.interval(item.interval), item.across_text(), *spread)


def _policy(item: Group) -> str:
    condition = item.condition
    parts = [condition.policy] + ([item.demonstrations] if item.several else [])
    parts += [f"{condition.axis} {condition.strength:g}"] if condition.axis else []
    return ", ".join(parts + ([f"expert in {condition.swap}"] if condition.swap else []))


def _paired(task: str, encoder: str, pairs: Sequence[tuple[float | None, Group | None]]) -> Iterator[str]:
    for rate, item in pairs:
        yield paper_text(task, encoder, rate)
        yield our_text(item)


def _csv(rows: Sequence[dict[str, Any]]) -> bytes:
    out = io.StringIO()
    if rows:
        writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return out.getvalue().encode()


def _escaped(words: str) -> str:
    """Return one line that Markdown takes as text in a table."""
    return re.sub(r"([|\\*_`<\[])", r"\\\1", " ".join(words.split()))


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head)]
    shown = ["| " + " | ".join(line) + " |" for line in lines]
    return [*shown, *("| " + " | ".join(map(_escaped, row)) + " |" for row in rows), ""]


def _latex_row(row: Sequence[str]) -> str:
    return " & ".join(map(escape_latex, row)) + r" \\"


def _latex_table(
    columns: str, head: Sequence[str], rows: Sequence[Sequence[str]], caption: str, label: str
) -> list[str]:
    """Return one floating table; a thin rule between tasks."""
    body: list[str] = []
    for index, row in enumerate(rows):
        if index and row[0] != rows[index - 1][0]:
            body.append(r"\addlinespace")
        body.append(_latex_row(row))
    return [
        r"\begin{table}", r"\centering\small", rf"\caption{{{escape_latex(caption)}}}", rf"\label{{{label}}}",
        rf"\begin{{tabular}}{{{columns}}}", r"\toprule", *head, r"\midrule", *body, r"\bottomrule",
        r"\end{tabular}", r"\end{table}", "",
    ]  # fmt: skip
