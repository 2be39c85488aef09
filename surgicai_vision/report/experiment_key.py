"""Conditions: what was evaluated, but for the training seed, as cells, checkpoints and tables tell
it.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.core.cameras import view_names
from surgicai_vision.core.tasks import task_names

COUNT = re.compile(r"^(\d+)([a-z]+)$")
"""A change of a recipe that is a number: "2epochs"."""


@dataclass(frozen=True)
class Condition:
    """What was evaluated, but for the training seed.

    Attributes:
        task: one of `tasks.task_names()`.
        encoder: the encoder; without one "proprioception" or "state", or the name of the chain or
            reference.
        views: its views.
        chain: how subtasks end in a chain, or "".
        trained_by: the policy's kind.
        pool: what is taken from the encoder.
        recipe: its recipe's name.
        changes: what is changed in the recipe.
        demonstrations: demonstrations asked for, where known.
        axis: what is shifted in a robustness evaluation, or "".
        strength: how much.
        swap: subtask in which the expert acts (chain), or "".
        trained: whether a policy was trained.
        place: where it stands, if another evaluation of the same condition and training seed stands
            elsewhere.
    """

    task: str
    encoder: str
    views: tuple[str, ...] = ()
    chain: str = ""
    trained_by: str = "bc"
    pool: str = "global"
    recipe: str = "paper"
    changes: tuple[str, ...] = ()
    demonstrations: int | None = None
    axis: str = ""
    strength: float = 0.0
    swap: str = ""
    trained: bool = True
    place: str = ""

    @property
    def variant(self) -> str:
        """Everything but inputs and demonstrations that is not as usual: not bc, global, paper."""
        usual = ((self.trained_by, "bc"), (self.pool, "global"), (self.recipe, "paper"))
        chain = f"chain, {self.chain} end" if self.chain else ""
        parts = [
            chain,
            *(part for part, common in usual if part != common),
            " + ".join(self.changes),
            self.place,
        ]
        return " · ".join(part for part in parts if part)

    @property
    def policy(self) -> str:
        """The policy without its views."""
        return self.encoder + (f" · {self.variant}" if self.variant else "")

    @property
    def view(self) -> str:
        """The view set."""
        return " + ".join(self.views)

    @property
    def label(self) -> str:
        """The policy with everything that tells it from its neighbours, but for the task."""
        parts = [self.policy + (f" on {self.view}" if self.views else "")]
        parts += [f"{self.axis} {self.strength:g}"] if self.axis else []
        parts += [f"expert in {self.swap}"] if self.swap else []
        return ", ".join(parts)

    @property
    def plain(self) -> bool:
        """Whether neither the world was shifted nor the expert swapped in."""
        return not self.axis and not self.swap


def condition_of(cell: Mapping[str, Any]) -> Condition:
    """Return the condition of a sweep's cell, from its own fields."""
    epochs = [f"{cell['epochs']}epochs"] if cell.get("epochs") else []
    return Condition(
        task=str(cell["task"]),
        encoder=str(
            cell.get("encoder") or ("state" if cell.get("privileged") else "proprioception")
        ),
        views=tuple(cell.get("view") or ()),
        chain=str(cell.get("chain") or ""),
        trained_by=cell.get("policy", "bc"),
        pool=cell.get("pool", "global"),
        recipe=Path(str(cell.get("recipe", "paper"))).stem,
        changes=_told([*cell.get("change", ()), *epochs]),
        demonstrations=cell.get("demonstrations"),
        swap=str(cell.get("swap") or ""),
    )


def condition_of_policy(summary: Mapping[str, Any], about: Mapping[str, Any]) -> Condition:
    """Return the condition of an evaluation that belongs to no cell, from what is kept beside
    it.
    """
    checkpoint = about.get("checkpoint") or {}
    encoder = about.get("encoder") or summary["policy"]
    if checkpoint and not about.get("views"):
        encoder = "state" if "state" in encoder.split("-") else "proprioception"
    recipe, *changes = checkpoint.get("recipe", "paper").split("+")
    return Condition(
        task=summary["task"],
        encoder=encoder,
        views=tuple(about.get("views") or ()),
        trained_by=checkpoint.get("policy", "bc"),
        pool=checkpoint.get("pool", "global"),
        recipe=recipe,
        changes=_told(changes),
        demonstrations=checkpoint.get("demonstrations"),
    )


def _told(changes: Sequence[str]) -> tuple[str, ...]:
    """Write what is changed in a recipe as people read it; demonstrations are told elsewhere."""
    return tuple(COUNT.sub(r"\1 \2", change) for change in changes if not change.endswith("demos"))


def order(condition: Condition) -> tuple[Any, ...]:
    """By task; in it trained policies first, by encoder, views and what else they are, then the
    references.
    """
    known = view_names()
    views = [known.index(view) if view in known else len(known) for view in condition.views]
    tasks = task_names()
    task = tasks.index(condition.task) if condition.task in tasks else len(tasks)
    more = (
        condition.variant,
        condition.demonstrations or 0,
        condition.axis,
        condition.strength,
        condition.swap,
    )
    return (task, not condition.trained, not views, condition.encoder, len(views), views, *more)
