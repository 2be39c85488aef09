"""Sections: the rows of the page's tables and maps, as the template prints them."""

from collections.abc import Collection, Sequence

from markupsafe import Markup

from surgicai_vision.core import names, percentages
from surgicai_vision.core.tasks import task_names
from surgicai_vision.core.words import plural
from surgicai_vision.evaluation.metrics import KINDS
from surgicai_vision.evaluation.statistics import clopper_pearson
from surgicai_vision.report import charts, paper, text
from surgicai_vision.report.experiment_key import Condition
from surgicai_vision.report.groups import MEASURES, Group, of_task
from surgicai_vision.report.pairs import Pair
from surgicai_vision.report.paper_comparison import beside_paper, our_text, paper_text
from surgicai_vision.report.reader import Result

PAIRS_SHOWN = 12


def paper_rows(groups: Sequence[Group], index: dict[Condition, int]) -> list[dict[str, object]]:
    """Return the paper's table next to ours, one row per task and encoder."""
    rows: list[dict[str, object]] = []
    for task, encoder, sides in beside_paper(groups):
        cells = []
        for rate, item in sides:
            evaluated = item is not None and item.episodes > 0
            drawing = Markup("")
            if item is not None and evaluated:
                drawing = charts.interval(
                    item.rate, *item.interval, our_text(item), _of_paper(rate)
                )
            count = (
                f"{item.successes}/{item.episodes}"
                if item is not None and evaluated
                else our_text(item)
            )
            cells.append(
                {
                    "paper": paper_text(task, encoder, rate),
                    "ours": count,
                    "interval": (
                        percentages.interval(item.interval)
                        if item is not None and evaluated
                        else ""
                    ),
                    "drawing": drawing,
                    "group": index[item.condition] if item is not None else None,
                    "state": "" if evaluated else "absent",
                }
            )
        rows.append(
            {
                "task": task,
                "encoder": encoder,
                "cells": cells,
                "starts": not rows or rows[-1]["task"] != task,
            }
        )
    return rows


def _of_paper(rate: float | None) -> tuple[float, float, float] | None:
    """Return the paper's rate with the exact interval of its episodes."""
    if rate is None:
        return None
    return rate, *clopper_pearson(round(rate * paper.EPISODES), paper.EPISODES)


def ceilings(groups: Sequence[Group]) -> str:
    """Return what the paper's state-based policies and ours reach: the upper bound."""
    parts = []
    for task, rate in paper.STATE_BC.items():
        mine = [
            item
            for item in of_task(groups, task)
            if item.condition.encoder == "state"
            and item.condition.is_as_published
            and item.episodes
        ]
        if of_task(groups, task):
            ours = f", ours {our_text(mine[-1])}" if mine else ""
            parts.append(f"{task} {percentages.percent(rate)}{ours}")
    return "; ".join(parts)


def heat_maps(groups: Sequence[Group], index: dict[Condition, int]) -> list[dict[str, object]]:
    """Return one heat map per view set: task × policy.

    Of several numbers of demonstrations the largest is shown. What all policies of a map have in
    common is in its title; what distinguishes them is above their columns.
    """
    plain = [
        item for item in groups if item.condition.plain and item.condition.task != names.SUTURE
    ]
    maps: list[dict[str, object]] = []
    several = False
    for views in dict.fromkeys(item.condition.views for item in plain):
        mine = [item for item in plain if item.condition.views == views]
        columns = list(dict.fromkeys(item.condition.parts for item in mine))
        shared = set(columns[0]).intersection(*columns) if len(columns) > 1 else set()
        tasks = [task for task in task_names() if of_task(mine, task)]
        rows = []
        for task in tasks:
            known = {item.condition.parts: item for item in of_task(mine, task)}
            rows.append(
                {"task": task, "cells": [_heat(known.get(column), index) for column in columns]}
            )
        several = several or len(rows) > 1
        seen = " + ".join(views) or "no images"
        maps.append(
            {
                "title": " · ".join([seen, *(part for part in columns[0] if part in shared)]),
                "columns": [_apart(parts, shared) for parts in columns],
                "rows": rows,
            }
        )
    return maps if several else []


def _apart(parts: Sequence[str], shared: Collection[str]) -> str:
    """Name a policy by what it does not share with the others, or else by everything."""
    return " · ".join(part for part in parts if part not in shared) or " · ".join(parts)


def _heat(item: Group | None, index: dict[Condition, int]) -> dict[str, object]:
    if item is None:
        return {
            "text": "",
            "small": "",
            "title": "not in this sweep",
            "group": None,
            "state": "none",
        }
    title = item.label
    group = index[item.condition]
    if not item.episodes:
        cell = item.missing[0]
        return {
            "text": cell.state,
            "small": "",
            "title": f"{title}: {cell.reason}",
            "group": group,
            "state": "absent",
        }
    back, front = charts.heat(item.rate)
    return {
        "text": percentages.percent(item.rate).removesuffix(" %"),
        "small": percentages.interval(item.interval).removesuffix(" %"),
        "title": f"{title}: {our_text(item)}",
        "group": group,
        "state": "",
        "back": back,
        "front": front,
    }


def success_row(at: int, item: Group, best: Group | None) -> dict[str, object]:
    """Return one line of the success table; `sort` holds what its columns are sorted by."""
    condition = item.condition
    row: dict[str, object] = {
        "group": at,
        "task": condition.task,
        "policy": condition.policy if condition.plain else condition.label,
        "encoder": condition.encoder,
        "views": condition.view or text.ABSENT,
        "details": item.details,
        "plain": condition.plain,
        "kind": "" if condition.trained else "reference",
        "note": _note(item),
        "evaluated": item.episodes > 0,
    }
    if not item.episodes:
        cell = item.missing[0]
        return {
            **row,
            "kind": "absent",
            "state": cell.state,
            "reason": _short(cell.reason),
            "sort": {},
        }
    low, high = item.interval
    length = item.on_successes("trajectory_length_mm")
    steps = item.on_successes("steps")
    label = f"{percentages.percent(item.rate)}, 95 % interval {percentages.interval((low, high))}"
    failures = ", ".join(
        f"{count} {kind.replace('_', ' ')}" for kind, count in item.failures.items()
    )
    return {
        **row,
        "kind": "best" if item is best and item.successes else row["kind"],
        "successes": item.successes,
        "episodes": item.episodes,
        "rate": percentages.percent(item.rate),
        "interval": percentages.interval((low, high)),
        "drawing": charts.interval(item.rate, low, high, label),
        "across": item.across_text().partition(" (")[0],
        "bootstrap": percentages.interval(item.across.interval) if item.across else "",
        "seeds": len(item.results),
        "length": text.mean(length),
        "steps": text.mean(steps),
        "outcomes": charts.outcomes(item.successes, item.failures),
        "failures": failures or "no failure",
        "sort": {
            "rate": item.rate,
            "across": item.across.mean if item.across else item.rate,
            "length": length["mean"],
            "steps": steps["mean"],
        },
    }


def _note(item: Group) -> str:
    """Say how many training seeds are missing, if others are there."""
    states = [cell.state for cell in item.missing]
    if not item.episodes or not states:
        return ""
    parts = [
        f"{plural(states.count(state), 'training seed')} {state}" for state in dict.fromkeys(states)
    ]
    return ", ".join(parts)


def measures(groups: Sequence[Group]) -> dict[str, object]:
    """Return the columns that some row measured, and their medians."""
    evaluated = [(at, item) for at, item in enumerate(groups) if item.episodes]
    kept = [
        spec for spec in MEASURES if any(text.finite(item.values(spec[0])) for _, item in evaluated)
    ]
    rows = []
    for at, item in evaluated:
        cells = []
        for column, *_ in kept:
            found = text.quartiles(item.values(column))
            middle, _, rest = text.spread(item.values(column)).partition(" ")
            cells.append((middle, rest, found[1] if found else None))
        condition = item.condition
        rows.append(
            {
                "group": at,
                "task": condition.task,
                "policy": item.label,
                "cells": cells,
                "encoder": condition.encoder,
                "views": condition.view or text.ABSENT,
                "plain": condition.plain,
                "kind": "" if condition.trained else "reference",
            }
        )
    explained = "; ".join(f"{what} [{unit}]: {why}" for _, what, unit, why in kept)
    return {"head": [(what, unit) for _, what, unit, _ in kept], "rows": rows, "caption": explained}


def pair_row(at: int, pair: Pair) -> dict[str, object]:
    """Return one comparison as text."""
    return {
        "more": at >= PAIRS_SHOWN,
        "task": pair.first.condition.task,
        "first": pair.first.label,
        "second": pair.second.label,
        "factor": pair.factor,
        "first_count": f"{pair.first.successes}/{pair.first.episodes}",
        "second_count": f"{pair.second.successes}/{pair.second.episodes}",
        "split": f"{pair.first_only} : {pair.second_only}",
        "episodes": pair.episodes,
        "p": text.probability(pair.p),
        "adjusted": text.probability(pair.adjusted),
        "sure": pair.adjusted < 0.05,
    }


def missing_rows(groups: Sequence[Group]) -> list[dict[str, object]]:
    """Return what has no result, one row for each condition, state and reason."""
    rows: dict[tuple[str, ...], list[int]] = {}
    for item in groups:
        for cell in item.missing:
            key = (item.condition.task, item.label, cell.state, " ".join(cell.reason.split()))
            rows.setdefault(key, []).append(cell.seed)
    return [
        {
            "task": task,
            "policy": policy,
            "seeds": ", ".join(map(str, seeds)),
            "state": state,
            "reason": reason,
        }
        for (task, policy, state, reason), seeds in rows.items()
    ]


def filters(groups: Sequence[Group]) -> list[tuple[str, list[str]]]:
    """Return what the table can be filtered by: name, values; a single value is left out."""
    values = {
        "task": [item.condition.task for item in groups],
        "encoder": [item.condition.encoder for item in groups],
        "views": [item.condition.view or text.ABSENT for item in groups],
    }
    found = [(name, list(dict.fromkeys(column))) for name, column in values.items()]
    return [(name, column) for name, column in found if len(column) > 1]


def kinds(groups: Sequence[Group]) -> list[str]:
    """Return the kinds of failure that occur, in the order in which charts stack them."""
    found = {kind for item in groups for kind in item.failures}
    return [kind for kind in KINDS if kind in found]


def caption(groups: Sequence[Group]) -> str:
    """Return what the numbers are and how the episodes were judged."""
    results = [result for item in groups for result in item.results]
    if not results:
        return ""
    meanings = {
        "missed": "never touched the needle",
        "dropped": "lost it",
        "wrong_hole": "went into another hole",
        "time": "still held it when time ran out",
        "physics": "diverged physics",
        "error": "no start or no finite action",
    }
    failures = "; ".join(f"{kind.replace('_', ' ')} = {meanings[kind]}" for kind in kinds(groups))
    configs = [result.config for result in results]
    limits = text.either(sorted(config.max_steps for config in configs))
    grasps = text.either(config.scene.grasp for config in configs)
    tolerances = text.either(config.tolerance for config in configs)
    return (
        "Successes of n episodes with the exact (Clopper–Pearson) interval; "
        f"{_starts(results)}. Trajectory length and time steps: mean ± standard deviation over"
        f" successful episodes, of at most {limits} steps. "
        + (f"Failures: {failures}. " if failures else "")
        + f"Grasp by {grasps}, {tolerances} tolerances."
    )


def _starts(results: Sequence[Result]) -> str:
    """Say from which starts the policies were evaluated, and whether these were the same."""
    counted = {tuple(sorted(row["seed"] for row in result.rows)) for result in results}
    ranges = text.either(f"{seeds[0]}–{seeds[-1]}" for seeds in sorted(counted))
    if len(counted) == 1:
        return f"the same starts, seeds {ranges}, for every policy"
    return f"for each policy, the starts of seeds {ranges}"


def _short(reason: str, most: int = 160) -> str:
    line = " ".join(reason.split())
    return line if len(line) <= most else line[: most - 1] + "…"
