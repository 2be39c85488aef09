"""Pairs: exact McNemar on the same starts, Holm's correction within a task.

Compared are trained conditions of a task that differ in one thing (`FACTORS`); recipes as wholes,
with the encoder, views and demonstrations of each; multiplied demonstrations against the few they
were made of; demonstrations and looks with the epochs that were trained on each; conditions of a
plan, with how subtasks end in each; and each with images against proprioception alone. Policies of
different kinds have recipes of their own, so on the same images and demonstrations they are
compared as wholes, but never two that were given different minutes of training. Episodes are paired
by training seed and start. The test speaks of the policies that were trained, not of all
that the same recipe might give.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from surgicai_vision.core.tasks import task_names
from surgicai_vision.evaluation import statistics
from surgicai_vision.report.experiment_key import Condition
from surgicai_vision.report.groups import Group, of_task

FACTORS: Mapping[str, str] = MappingProxyType(
    {
        "encoder": "encoder",
        "views": "views",
        "hierarchical": "hierarchical policy",
        "trained_by": "policy",
        "pool": "pool",
        "recipe": "recipe",
        "changes": "change",
        "acted_by": "change in acting",
        "demonstrations": "demonstrations",
        "looks": "looks",
        "multiplied_from": "multiplied demonstrations",
        "dagger_rounds": "rounds of DAgger",
        "world": "world",
        "learned_in": "world of the demonstrations",
        "name": "condition",
        "place": "place",
    }
)
"""Attribute of a condition → how a difference in it is called."""
AMOUNTS = ("demonstrations", "looks", "multiplied_from", "dagger_rounds")
"""Fields that say how much there was to learn from."""


@dataclass(frozen=True)
class Pair:
    """Two conditions on the same starts.

    Attributes:
        factor: what they differ in.
        episodes: paired episodes.
        first_only: episodes that only the first solved; likewise `second_only`.
        p: exact two-sided McNemar.
        adjusted: after Holm, over all pairs of the task.
    """

    first: Group
    second: Group
    factor: str
    episodes: int
    first_only: int
    second_only: int
    p: float
    adjusted: float = 1.0


def compare(groups: Sequence[Group]) -> list[Pair]:
    """Return every pair of each task, the smallest p-value first."""
    pairs: list[Pair] = []
    for task in task_names():
        trained = [
            item
            for item in of_task(groups, task, plain=False)
            if _is_compared(item.condition) and item.episodes
        ]
        candidates = [_pair(*two) for two in itertools.combinations(trained, 2)]
        found = [pair for pair in candidates if pair is not None]
        adjusted = statistics.holm([pair.p for pair in found]) if found else []
        pairs += [replace(pair, adjusted=float(p)) for pair, p in zip(found, adjusted, strict=True)]
    return sorted(pairs, key=lambda pair: (pair.adjusted, pair.p))


def factor(first: Condition, second: Condition) -> str:
    """Name the one thing two conditions differ in, or ""."""
    if "state" in (first.encoder, second.encoder):
        return ""
    blind = not first.views or not second.views
    fields = [
        name for name in FACTORS if not (blind and name == "pool")
    ]  # no encoder, nothing taken from it
    differ = [name for name in fields if getattr(first, name) != getattr(second, name)]
    same_kind = "trained_by" not in differ
    if "recipe" in differ and same_kind and bool(first.views) == bool(second.views):
        whole = ("encoder", "views", "pool", "recipe", "changes", "demonstrations")
        differ = [name for name in differ if name == "recipe" or name not in whole]
    if {"trained_by", "recipe"} <= set(differ) and _same_budget(first, second):
        differ = [name for name in differ if name not in ("recipe", "changes")]
    if "multiplied_from" in differ and _originals(first) == _originals(second):
        differ = [name for name in differ if name != "demonstrations"]
    if "dagger_rounds" in differ:  # a round brings demonstrations of its own
        differ = [name for name in differ if name != "demonstrations"]
    if set(differ) & set(AMOUNTS) and _without_amounts(first) == _without_amounts(second):
        differ = [name for name in differ if name != "changes"]
    if "name" in differ:  # it says in which world
        differ = [name for name in differ if name not in ("hierarchical", "world")]
    if blind:
        differ = ["images" if name == "encoder" else name for name in differ if name != "views"]
    return FACTORS.get(differ[0], differ[0]) if len(differ) == 1 else ""


def _without_amounts(condition: Condition) -> list[str]:
    """Return what is changed in the recipe but for how many frames of how many epochs it takes.

    More demonstrations need fewer of both.
    """
    amounts = ("epochs=", "frame_stride=")
    return [change for change in condition.changes if not change.startswith(amounts)]


def _same_budget(first: Condition, second: Condition) -> bool:
    """Return False where both have a budget of minutes, each another."""
    return None in (first.minutes, second.minutes) or first.minutes == second.minutes


def _originals(condition: Condition) -> int | None:
    """Return how many demonstrations there were before any was multiplied."""
    return condition.multiplied_from or condition.demonstrations


def _is_compared(condition: Condition) -> bool:
    """Return True for what is trained and evaluated as trained, or in a condition of a plan."""
    return condition.trained and (condition.plain or bool(condition.name))


def _pair(first: Group, second: Group) -> Pair | None:
    differs = factor(first.condition, second.condition)
    if not differs:
        return None
    one = _outcomes(first)
    other = _outcomes(second)
    common = sorted(one.keys() & other.keys())
    if not common:
        return None
    a = [one[key] for key in common]
    b = [other[key] for key in common]
    first_only = sum(x and not y for x, y in zip(a, b, strict=True))
    second_only = sum(y and not x for x, y in zip(a, b, strict=True))
    return Pair(
        first,
        second,
        differs,
        len(common),
        first_only,
        second_only,
        float(statistics.mcnemar(a, b)),
    )


def _outcomes(item: Group) -> dict[tuple[int, int], bool]:
    """Map (training seed, start) to success."""
    return {
        (result.seed, row["seed"]): bool(row["success"])
        for result in item.results
        for row in result.rows
    }
