"""Formats: the tables as Markdown and as LaTeX."""

import re
from collections.abc import Iterator, Sequence

from surgicai_vision.core import percentages
from surgicai_vision.report import paper, text
from surgicai_vision.report.groups import Group, starts_of
from surgicai_vision.report.paper_comparison import beside_paper, our_text, paper_text

HEAD = (
    "task",
    "policy",
    "views",
    "k/n",
    "success",
    "95 % interval",
    "across training seeds",
    "length [mm]",
    "steps",
)
CAPTION = (
    "Intervals: exact (Clopper-Pearson), 95 %, episodes of all training seeds together; across"
    " training seeds: mean, standard deviation, hierarchical bootstrap interval and each seed's"
    " successes. Length and steps: mean and standard deviation over successful episodes."
)
_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    "±": r"$\pm$",
    "·": r"$\cdot$",
    "×": r"$\times$",
    "°": r"$^\circ$",
    "<": "$<$",
    ">": "$>$",
}


def markdown(groups: Sequence[Group], title: str) -> str:
    """Return the tables as Markdown."""
    parts = [f"# {escape_markdown(title)}", ""]
    rows = beside_paper(groups)
    if rows:
        parts += [
            f"Success next to the paper's ({paper.SOURCE}); ours: k/n and exact 95 % interval.",
            "",
        ]
        parts += _markdown(
            ("task", "encoder", "front, paper", "front, ours", "back, paper", "back, ours"),
            [(task, encoder, *_paired(task, encoder, pairs)) for task, encoder, pairs in rows],
        )
    parts += [
        f"Success from {starts_of(groups)}. {CAPTION}",
        "",
        *_markdown(HEAD, [_record(item) for item in groups]),
    ]
    lines = [
        (item.condition.task, item.label, str(cell.seed), cell.state, cell.reason)
        for item in groups
        for cell in item.missing
    ]
    if lines:
        parts += ["Cells without a result.", ""]
        parts += _markdown(("task", "policy", "training seed", "state", "reason"), lines)
    return "\n".join(parts).rstrip() + "\n"


def latex(groups: Sequence[Group], title: str) -> str:
    """Return the tables as LaTeX.

    The document needs the package booktabs and, for many rows, a smaller font.
    """
    parts = ["% needs \\usepackage{booktabs}"]
    rows = beside_paper(groups)
    if rows:
        body = [(task, encoder, *_paired(task, encoder, pairs)) for task, encoder, pairs in rows]
        spans = r"\multicolumn{2}{c}{front} & \multicolumn{2}{c}{back} \\"
        head = ["& & " + spans, r"\cmidrule(lr){3-4}\cmidrule(lr){5-6}"]
        head.append(_latex_row(("task", "encoder", "paper", "ours", "paper", "ours")))
        caption = (
            f"Success rates next to those of {paper.SOURCE}; ours: k/n and exact 95 % interval."
        )
        parts += _latex_table("llrrrr", head, body, caption, "tab:paper")
    body = [_record(item) for item in groups]
    parts += _latex_table(
        "lllrrrrrr", [_latex_row(HEAD)], body, f"{title}. {CAPTION}", "tab:success"
    )
    return "\n".join(parts) + "\n"


def escape_latex(words: str) -> str:
    """Escape what LaTeX reads as a command."""
    return "".join(_LATEX.get(letter, letter) for letter in words)


def _record(item: Group) -> tuple[str, ...]:
    start = (item.condition.task, _policy(item), item.condition.view or text.ABSENT)
    if not item.episodes:
        return (*start, item.missing[0].state, *[text.ABSENT] * 5)
    count = f"{item.successes}/{item.episodes}"
    spread = [text.mean(item.on_successes(column)) for column in ("trajectory_length_mm", "steps")]
    return (
        *start,
        count,
        percentages.percent(item.rate),
        percentages.interval(item.interval),
        item.across_text(),
        *spread,
    )


def _policy(item: Group) -> str:
    condition = item.condition
    parts = [condition.policy] + ([item.details] if item.details else [])
    parts += [f"{condition.axis} {condition.strength:g}"] if condition.axis else []
    parts += [f"expert in {condition.expert_swap}"] if condition.expert_swap else []
    parts += ["each episode upset"] if condition.upset else []
    return ", ".join(parts)


def _paired(
    task: str, encoder: str, pairs: Sequence[tuple[float | None, Group | None]]
) -> Iterator[str]:
    for rate, item in pairs:
        yield paper_text(task, encoder, rate)
        yield our_text(item)


def escape_markdown(words: str) -> str:
    """Return one line that Markdown reads as plain text in a table."""
    return re.sub(r"([|\\*_`<\[])", r"\\\1", " ".join(words.split()))


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head)]
    shown = ["| " + " | ".join(line) + " |" for line in lines]
    return [*shown, *("| " + " | ".join(map(escape_markdown, row)) + " |" for row in rows), ""]


def _latex_row(row: Sequence[str]) -> str:
    return " & ".join(map(escape_latex, row)) + r" \\"


def _latex_table(
    columns: str, head: Sequence[str], rows: Sequence[Sequence[str]], caption: str, label: str
) -> list[str]:
    """Return one floating table, with extra space between tasks."""
    body: list[str] = []
    for index, row in enumerate(rows):
        if index and row[0] != rows[index - 1][0]:
            body.append(r"\addlinespace")
        body.append(_latex_row(row))
    return [
        r"\begin{table}",
        r"\centering\small",
        rf"\caption{{{escape_latex(caption)}}}",
        rf"\label{{{label}}}",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        *head,
        r"\midrule",
        *body,
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
        "",
    ]
