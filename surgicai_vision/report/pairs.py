"""Pairs: exact McNemar on the same starts, Holm's correction within a task.

Trained conditions of a task are compared if they differ in one thing (`FACTORS`). Some things count
as one together with what belongs to them:

* recipes, each with its encoder, views, budget and demonstrations;
* multiplied demonstrations, against the few they were made from;
* demonstrations and looks, each with the epochs trained on them;
* conditions of a plan, each with how its subtasks end;
* policies with images, against proprioception alone;
* policies of different kinds, each with its own recipe, on the same images and demonstrations, but
  never two that were given different minutes of training.

Episodes are paired by training seed and start. The test is about the policies that were trained,
not about all that the same recipe might produce.
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
        "aimed": "aim of the crops",
        "demonstrations": "demonstrations",
        "looks": "looks",
        "multiplied_from": "multiplied demonstrations",
        "dagger_rounds": "rounds of DAgger",
        "demonstrator": "demonstrator",
        "noise": "noise of the demonstrations",
        "post_success_steps": "steps after success",
        "budget": "budget",
        "world": "world",
        "learned_in": "world of the demonstrations",
        "rules": "rules",
        "name": "condition",
        "place": "place",
    }
)
"""Attribute of a condition → the name of a difference in it."""
AMOUNTS = ("demonstrations", "looks", "multiplied_from", "dagger_rounds")
"""Fields that say how much there was to learn from."""
DEMONSTRATED = ("demonstrations", "demonstrator", "noise", "post_success_steps")
"""Fields that say what was demonstrated, by whom and how."""
OF_RECIPES = ("encoder", "views", "pool", "changes", "budget", *DEMONSTRATED)
OF_KINDS = ("recipe", "changes")
OF_CONDITIONS = ("hierarchical", "aimed", "world", "rules")
"""What belongs to a recipe, to a kind of policy, and to a condition of a plan."""


@dataclass(frozen=True)
class Pair:
    """Two conditions on the same starts.

    Attributes:
        factor: what they differ in.
        episodes: paired episodes.
        first_only: episodes that only the first solved; likewise `second_only`.
        p: p-value of the exact two-sided McNemar test.
        adjusted: p-value after Holm's correction over all pairs of the task.
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
    differ = {name for name in FACTORS if getattr(first, name) != getattr(second, name)}
    are_blind = [not first.views, not second.views]
    same_kind = "trained_by" not in differ
    # Each: whether it holds, and the differences that then belong to another one.
    belongs: tuple[tuple[bool, tuple[str, ...]], ...] = (
        ("recipe" in differ and same_kind and len(set(are_blind)) == 1, OF_RECIPES),
        ({"trained_by", "recipe"} <= differ and _same_budget(first, second), OF_KINDS),
        (not same_kind, ("budget",)),
        ("multiplied_from" in differ and _originals(first) == _originals(second), DEMONSTRATED),
        ("dagger_rounds" in differ, DEMONSTRATED),
        (not differ.isdisjoint(AMOUNTS) and _alike_otherwise(first, second), ("changes",)),
        ("name" in differ, OF_CONDITIONS),
        (any(are_blind), ("pool", "views")),  # without an encoder, nothing is pooled
        (differ != {"place"}, ("place",)),  # where one was measured twice is no difference
    )
    differ -= {name for holds, names in belongs if holds for name in names}
    if len(differ) != 1:
        return ""
    (name,) = differ
    if name == "encoder" and first.hierarchical and second.hierarchical:
        return FACTORS["hierarchical"]  # there it is the name of the whole policy
    return "images" if name == "encoder" and any(are_blind) else FACTORS[name]


def _alike_otherwise(first: Condition, second: Condition) -> bool:
    """Return True if the recipes are changed alike, frames and epochs aside."""
    return _without_amounts(first) == _without_amounts(second)


def _without_amounts(condition: Condition) -> list[str]:
    """Return what is changed in the recipe, except for the frames and epochs that it uses.

    More demonstrations need fewer of both.
    """
    amounts = ("epochs=", "frame_stride=")
    return [change for change in condition.changes if not change.startswith(amounts)]


def _same_budget(first: Condition, second: Condition) -> bool:
    """Return False if both have a budget of minutes and these differ."""
    return None in (first.minutes, second.minutes) or first.minutes == second.minutes


def _originals(condition: Condition) -> int | None:
    """Return how many demonstrations there were before any was multiplied."""
    return condition.multiplied_from or condition.demonstrations


def _is_compared(condition: Condition) -> bool:
    """Return True for a trained policy that is evaluated plainly, or in a condition of a plan."""
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
