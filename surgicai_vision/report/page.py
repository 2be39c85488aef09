"""The page: what the template is filled with."""

import datetime
import json
from collections.abc import Sequence

from markupsafe import Markup

from surgicai_vision.core import names, percentages
from surgicai_vision.core.tasks import task_names
from surgicai_vision.core.words import noun, plural
from surgicai_vision.report import charts, curves, dependence, paper, sections
from surgicai_vision.report.dependence import Dependence
from surgicai_vision.report.episodes import group_details, letters
from surgicai_vision.report.filmstrips import Reel
from surgicai_vision.report.groups import (
    Group,
    as_trained,
    best_trained,
    of_task,
    starts_of,
)
from surgicai_vision.report.high_level import high_level_policies
from surgicai_vision.report.pairs import Pair
from surgicai_vision.report.probes import probes
from surgicai_vision.report.reader import Collected
from surgicai_vision.report.reinforcement import learned
from surgicai_vision.report.retention import looks, retentions

FEW = 12
"""Most other policies that the text below the headline lists."""
CHOSEN = "is the best of several and was chosen after the fact, so its interval is optimistic."
"""What is said of a policy that is named because it did best."""


def render(page: dict[str, object]) -> str:
    """Fill the template."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("surgicai_vision.report", "templates")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.j2").render(page)


def numbers(
    collected: Collected,
    groups: Sequence[Group],
    pairs: Sequence[Pair],
    dependences: Sequence[Dependence],
) -> dict[str, object]:
    """Return everything but images and provenance."""
    index = {item.condition: at for at, item in enumerate(groups)}
    best = {task: best_trained(of_task(groups, task)) for task in task_names()}
    return {
        **(_told(collected) or headline(groups)),
        "starts": starts_of(groups),
        "counts": _counts(collected),
        "paper": sections.paper_rows(groups, index),
        "paper_source": paper.SOURCE,
        "paper_episodes": paper.EPISODES,
        "ceilings": sections.ceilings(groups),
        "heats": sections.heat_maps(groups, index),
        "rows": [
            sections.success_row(at, item, best.get(item.condition.task))
            for at, item in enumerate(groups)
        ],
        "across_seeds": any(item.across for item in groups),
        "shifted": len({item.condition.plain for item in groups}) > 1,
        "filters": sections.filters(groups),
        "caption": sections.caption(groups),
        "kinds": [
            (kind.replace("_", " "), charts.KIND_COLOURS[kind])
            for kind in ("success", *sections.kinds(groups))
        ],
        "measures": sections.measures(groups),
        "data_curves": curves.data_curves(groups),
        "budget_curves": curves.budget_curves(groups),
        "robustness": curves.robustness_curves(groups),
        "retentions": retentions(groups),
        "looks": looks(groups),
        "dependences": dependence.rows(dependences),
        "few": dependence.FEW,
        "procedure": curves.procedure(groups),
        "learned": learned(groups),
        "learned_source": paper.LEARNED_SOURCE,
        "high_level": high_level_policies(collected.results),
        "subtasks": names.SUBTASKS,
        "paper_procedure": ", ".join(percentages.percent(rate) for rate in paper.HIERARCHICAL),
        "probes": probes(collected.probes, groups),
        "pairs": [sections.pair_row(at, pair) for at, pair in enumerate(pairs)],
        "pairs_shown": sections.PAIRS_SHOWN,
        "letters": letters(),
        "missing": sections.missing_rows(groups),
        "notes": collected.notes,
    }


def _told(collected: Collected) -> dict[str, str]:
    """Return the main finding as the run itself states it; empty if it does not."""
    run = collected.run
    return {key: run[key] for key in ("headline", "lead")} if run.get("headline") else {}


def headline(groups: Sequence[Group]) -> dict[str, str]:
    """Return the main finding in one sentence, and what to compare it with."""
    evaluated = as_trained(groups)
    tasks = list(dict.fromkeys(item.condition.task for item in evaluated))
    if not evaluated:
        return {
            "headline": "No cell has a result yet",
            "lead": "What is missing, and why, is listed below.",
        }
    if len(tasks) > 1:
        return _headline_of_many(evaluated, tasks)
    shown = best_trained(evaluated) or evaluated[0]
    task = shown.condition.task
    label = shown.label
    starts = f"{shown.condition.starts} starts of {task}"
    count = f"{shown.successes} of {shown.episodes} {starts}"
    sentence = f"{label} solves {count}"
    if shown.condition.trained and not shown.successes:
        sentence = f"No trained policy solves any of {shown.episodes} {starts}"
    first = (
        f"{percentages.percent(shown.rate)}, 95 % interval {percentages.interval(shown.interval)}."
    )
    lead = (
        f"That is {first}"
        if shown.successes or not shown.condition.trained
        else f"The best: {first}"
    )
    if shown.successes and sum(item.condition.trained for item in evaluated) > 1:
        lead += f" It {CHOSEN}"
    others = [
        f"{item.label} {item.successes}/{item.episodes}" for item in evaluated if item is not shown
    ]
    return {
        "headline": sentence,
        "lead": lead + (f" For comparison: {'; '.join(others[:FEW])}." if others else ""),
    }


def _headline_of_many(evaluated: list[Group], tasks: list[str]) -> dict[str, str]:
    """Return the best of each task.

    The best of several is chosen after the fact, and the page says so.
    """
    best = [
        found for task in tasks if (found := best_trained(of_task(evaluated, task, plain=False)))
    ]
    if not best:
        return {
            "headline": f"References on {plural(len(tasks), 'task')}",
            "lead": "No trained policy was run.",
        }
    if not any(item.successes for item in best):
        episodes = sum(item.episodes for item in evaluated if item.condition.trained)
        sentence = (
            f"No trained policy solves any of its {starts_of(best)} of {plural(len(best), 'task')}"
        )
        return {
            "headline": sentence,
            "lead": f"{episodes:,} episodes; each policy's interval is given below.",
        }
    bounds = (min(item.rate for item in best), max(item.rate for item in best))
    span = " to ".join(dict.fromkeys(map(percentages.percent, bounds)))
    parts = [
        f"{item.condition.task} {item.successes}/{item.episodes}"
        f" ({percentages.interval(item.interval)}; {item.label})"
        for item in best
    ]
    trained = [item.condition.task for item in evaluated if item.condition.trained]
    chosen = [item.condition.task for item in best if trained.count(item.condition.task) > 1]
    which = "Each" if len(chosen) == len(best) else f"That of {' and '.join(chosen)}"
    warning = f" {which} {CHOSEN}" if chosen else ""
    whose = f"each of {len(best)} tasks" if len(best) > 1 else best[0].condition.task
    return {
        "headline": f"The best trained policy of {whose} solves {span} of its {starts_of(best)}",
        "lead": f"{'; '.join(parts)}.{warning}",
    }


def _counts(collected: Collected) -> list[tuple[int, str]]:
    trained = sum(result.trained for result in collected.results)
    states = [cell.state for cell in collected.missing]
    counts = [(trained, "done"), *((states.count(state), state) for state in sorted(set(states)))]
    episodes = sum(len(result.rows) for result in collected.results)
    runs = trained + len(states)
    return [(runs, noun(runs, "run")), *counts, (episodes, noun(episodes, "episode"))]


def details(groups: Sequence[Group], reel: Reel, commands: dict[str, list[str]]) -> Markup:
    """Return what a click shows, as JSON that is safe in a script element.

    Args:
        groups: the conditions, in the order of the page.
        reel: the films.
        commands: folder of a result → the commands that reproduce its number.
    """
    shown_on_page = {choice.identity for choices in reel.compared.values() for choice in choices}
    made = [group_details(item, reel, commands, shown_on_page) for item in groups]
    words = json.dumps(made, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Markup(
        words.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    )


def footer(collected: Collected) -> str:
    """Return when and from what the page was written."""
    count = plural(len(collected.results), "stored evaluation")
    return f"Written on {datetime.date.today().isoformat()} from {count}."
