"""The key of an experiment: what was evaluated, except for the training seed."""

import itertools
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

from surgicai_vision.core.banks import HELD_OUT
from surgicai_vision.core.cameras import view_names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig, read_changes, world_text
from surgicai_vision.core.tasks import task_names
from surgicai_vision.evaluation.robustness.axes import SHIFTS, shifted_config
from surgicai_vision.rl.algorithms import ALGORITHMS
from surgicai_vision.training.run_config import BUDGET, RunConfig, Shift

USUAL = "the usual world"
"""The name of a world in which nothing varies."""
RULES = (
    "step",
    "tolerance",
    "max_steps",
    "action_repeat",
    "hold_jaw",
    "end_on_drop",
    "advance",
)
"""Fields of `TaskConfig` that decide what an action does and when an episode ends or succeeds."""


@dataclass(frozen=True)
class Condition:
    """What was evaluated, except for the training seed.

    Attributes:
        task: one of `names.TASKS`.
        encoder: the encoder; without one, "proprioception" or "state", or the name of the
            hierarchical policy or reference.
        views: the policy's views.
        hierarchical: how subtasks end under a hierarchical policy, or "".
        trained_by: the policy's kind.
        pool: what is taken from the encoder.
        recipe: the recipe's name, or the path of its file.
        changes: what is changed in the recipe.
        acted_by: what is changed in the recipe for the evaluation only.
        aimed: the detector that aims its crops, by the first digits of its hash; "" if they lie
            where the arm reports its jaws.
        demonstrations: demonstrations trained on, validation included; None if not known.
        looks: the looks in which each demonstration was rendered, or "".
        multiplied_from: how many demonstrations those were re-posed from; None if they were not.
        dagger_rounds: rounds of DAgger that those include.
        demonstrator: who demonstrated; "" if not known.
        noise: strength of the disturbance of the demonstrator's executed actions.
        post_success_steps: control steps that demonstrations continue after their success.
        budget: updates or control steps that the training was given, or "".
        world: what differs from the usual in the world of the evaluation, before a shift; "" if
            nothing does.
        recorded_in: the same for the demonstrations' world, if it is a different one; else "". Also
            "" for a hierarchical policy, each of whose parts has its own.
        rules: the `RULES` of the evaluation that differ from the task's, each with its value; "" if
            none does.
        axis: what is shifted in a robustness evaluation, or "".
        strength: how much it is shifted.
        expert_swap: subtask of a hierarchical policy in which the expert acts, or "".
        upset: whether one thing went wrong on purpose in every episode.
        name: name of the condition in a plan, or "".
        trained: whether a policy was trained.
        starts: the bank that the starts are from (`core.banks`).
        place: where it is stored, if another evaluation of the same condition and training seed is
            stored elsewhere.
    """

    task: str
    encoder: str
    views: tuple[str, ...] = ()
    hierarchical: str = ""
    trained_by: str = "bc"
    pool: str = "global"
    recipe: str = "paper"
    changes: tuple[str, ...] = ()
    acted_by: tuple[str, ...] = ()
    aimed: str = ""
    demonstrations: int | None = None
    looks: str = ""
    multiplied_from: int | None = None
    dagger_rounds: int = 0
    demonstrator: str = ""
    noise: float = 0.0
    post_success_steps: int = 0
    budget: str = ""
    world: str = ""
    recorded_in: str = ""
    rules: str = ""
    axis: str = ""
    strength: float = 0.0
    expert_swap: str = ""
    upset: bool = False
    name: str = ""
    trained: bool = True
    starts: str = HELD_OUT
    place: str = ""

    @property
    def parts(self) -> tuple[str, ...]:
        """The encoder, then everything unusual: what is not bc, global, paper.

        Inputs and demonstrations are left out. A recipe with the same name as the policy's kind is
        not repeated; recipe paper is named if behaviour cloning changes it.
        """
        is_changed = self.trained_by == "bc" and bool(self.changes)
        usual = (
            (self.trained_by, "bc"),
            (self.pool, "global"),
            (self.recipe, "" if is_changed else "paper"),
        )
        parts = (
            self.encoder,
            f"hierarchical, {self.hierarchical} end" if self.hierarchical else "",
            *dict.fromkeys(part for part, common in usual if part != common),
            " + ".join(self.changes),
            f"acting by {' + '.join(self.acted_by)}" if self.acted_by else "",
            f"crops aimed by detector {self.aimed}" if self.aimed else "",
            *self.amounts,
            *self.surroundings,
            self.place,
        )
        return tuple(part for part in parts if part)

    @property
    def amounts(self) -> tuple[str, ...]:
        """Everything unusual about how much it learned from, demonstrations aside."""
        parts = (
            self.looks,
            f"multiplied from {self.multiplied_from}" if self.multiplied_from else "",
            f"rounds of DAgger: {self.dagger_rounds}" if self.dagger_rounds else "",
        )
        return tuple(part for part in parts if part)

    @property
    def surroundings(self) -> tuple[str, ...]:
        """Everything unusual about where it learned and was evaluated; a name says which world."""
        parts = (
            f"demonstrated in {self.recorded_in}" if self.recorded_in else "",
            f"in {self.world}" if self.world and not self.name else "",
            f"with {self.rules}" if self.rules and not self.name else "",
            self.name,
            "" if self.is_held_out else f"{self.starts} starts",
        )
        return tuple(part for part in parts if part)

    @property
    def details(self) -> tuple[str, ...]:
        """What the label may leave out, each in words or "", in the same order for all."""
        return (
            "" if self.demonstrations is None else f"{self.demonstrations} demonstrations",
            f"demonstrated by {self.demonstrator}" if self.demonstrator else "",
            f"noise {self.noise:g}",
            f"{self.post_success_steps} steps after each success",
            self.budget,
            f"in {self.world or USUAL}",
            f"with {self.rules}" if self.rules else "",
        )

    @property
    def is_held_out(self) -> bool:
        """Whether it was evaluated on starts that no part of the policy has met."""
        return self.starts == HELD_OUT

    @property
    def is_as_published(self) -> bool:
        """Whether starts are held out, and world and rules the usual ones, as in the paper."""
        return self.is_held_out and not (self.world or self.recorded_in or self.rules)

    @property
    def variant(self) -> str:
        """Everything unusual, except for encoder, inputs and demonstrations."""
        return " · ".join(self.parts[1:])

    @property
    def policy(self) -> str:
        """The policy without its views."""
        return " · ".join(self.parts)

    @property
    def learned_in(self) -> str:
        """What differs from the usual in the demonstrations' world; "" if it is hierarchical."""
        return "" if self.hierarchical else self.recorded_in or self.world or USUAL

    @property
    def view(self) -> str:
        """The view set."""
        return " + ".join(self.views)

    @property
    def label(self) -> str:
        """The policy with everything that distinguishes it from others, except for the task."""
        parts = [self.policy + (f" on {self.view}" if self.views else "")]
        parts += [f"{self.axis} {self.strength:g}"] if self.axis else []
        parts += [f"expert in {self.expert_swap}"] if self.expert_swap else []
        parts += ["each episode upset"] if self.upset else []
        return ", ".join(parts)

    @property
    def unshifted(self) -> "Condition":
        """The condition without its shift: what the strengths of all its axes have in common."""
        return replace(self, axis="", strength=0.0)

    @property
    def plain(self) -> bool:
        """Whether the world was not shifted, the expert not swapped in, and nothing upset."""
        return not (self.axis or self.expert_swap or self.upset)

    @property
    def minutes(self) -> float | None:
        """Its training budget on one core [min]; None if it had none."""
        minutes = read_changes(self.changes).get(BUDGET)
        return float(minutes) if isinstance(minutes, int | float) else None

    @property
    def without_budget(self) -> "Condition":
        """The condition without the budget of its training."""
        kept = tuple(change for change in self.changes if BUDGET not in read_changes([change]))
        return replace(self, changes=kept)


def condition_of(run: RunConfig, place: str = "") -> Condition:
    """Return the condition of a run.

    Args:
        run: the run.
        place: where its evaluation is stored, if another one of the same run is stored elsewhere.
    """
    encoder = run.encoder or run.inputs
    if not run.is_trained:
        encoder = run.policy
    elif run.parts:
        encoder = f"hierarchical-{run.parts[:8]}"
    return Condition(
        task=run.task,
        encoder=encoder,
        views=run.views,
        hierarchical=run.termination or "",
        trained_by=(run.algo or run.policy) if run.is_trained else Condition.trained_by,
        pool=run.pool,
        recipe=run.recipe,
        changes=run.changes,
        acted_by=run.acted_by,
        aimed=run.detector[:8],
        demonstrations=run.demonstrations,
        looks=run.variants.text if run.variants else "",
        multiplied_from=run.multiplied_from,
        dagger_rounds=run.dagger_rounds,
        demonstrator=run.demonstrator or "",
        noise=run.noise,
        post_success_steps=run.post_success_steps,
        budget=_budget(run),
        **_worlds(run),
        rules=_rules(run),
        axis=run.shift.axis if run.shift else "",
        strength=run.shift.strength if run.shift else 0.0,
        expert_swap=run.expert_swap or "",
        upset=run.upset,
        name=run.condition,
        trained=run.is_trained,
        starts=run.starts.bank if run.starts else HELD_OUT,
        place=place,
    )


def _worlds(run: RunConfig) -> dict[str, str]:
    """Return a condition's `world` and `recorded_in`, each of them before a shift."""
    world = world_text(_unshifted(run, run.shift) if run.shift else run.env)
    learned = world_text(run.recorded_in) if run.recorded_in else ""
    is_away = run.recorded_in and not run.is_hierarchical and not (run.shift and learned == world)
    return {"world": world, "recorded_in": (learned or USUAL) if is_away else ""}


def _unshifted(run: RunConfig, shift: Shift) -> TaskConfig:
    """Return the env that a shift was added to: where the policy learned, or else without it.

    What a shift was added to is not known where both together exceeded a limit.
    """
    env = run.env
    axis = SHIFTS.get(shift.axis)
    if axis is None:
        return env
    if run.recorded_in:
        learned = replace(env, randomisation=run.recorded_in.randomisation)
        # The env of a run that is only planned is not shifted yet.
        if env in (learned, shifted_config(learned, axis, shift.strength)):
            return learned
    alone = asdict(shifted_config(TaskConfig(run.task), axis, shift.strength).randomisation)
    table = asdict(env.randomisation)
    for name in axis.world:
        table[name] = max(0, round(table[name] - alone[name], 9))
    return replace(env, randomisation=RandomisationConfig(**table))


def _budget(run: RunConfig) -> str:
    """Return the updates or control steps that a run's training was given.

    Control steps of a correction and of a high-level policy are measured, not given: they differ
    between training seeds.
    """
    if run.updates is not None:
        frames = f" of {run.batch_size} frames" if run.batch_size else ""
        return f"{run.updates:,} updates{frames}"
    return f"{run.env_steps:,} control steps" if run.env_steps and run.algo in ALGORITHMS else ""


def _rules(run: RunConfig) -> str:
    """Return the `RULES` of a run's env that differ from its task's, each with its value.

    A hierarchical policy brings its own step limit, and its own `advance`.
    """
    usual = TaskConfig(run.task)
    own = ("max_steps", "advance") if run.is_hierarchical else ()
    return ", ".join(
        f"{rule} {getattr(run.env, rule)}"
        for rule in RULES
        if rule not in own and getattr(run.env, rule) != getattr(usual, rule)
    )


def distinctions(conditions: Iterable[Condition]) -> dict[Condition, str]:
    """Return the details in which each condition differs from those of its task with its label.

    They are "" for a condition whose label no other one of its task has.
    """
    alike: dict[tuple[str, str], list[Condition]] = {}
    for condition in conditions:
        alike.setdefault((condition.task, condition.label), []).append(condition)
    found = {}
    for same in alike.values():
        columns = zip(*(condition.details for condition in same), strict=True)
        differs = [len(set(column)) > 1 for column in columns]
        for condition in same:
            words = itertools.compress(condition.details, differs)
            found[condition] = ", ".join(filter(None, words))
    return found


def labels(conditions: Iterable[Condition]) -> dict[Condition, str]:
    """Return the label of each condition, with its details where others have that label too."""
    return {
        condition: ", ".join(filter(None, (condition.label, details)))
        for condition, details in distinctions(conditions).items()
    }


type Text = tuple[tuple[str, float], ...]
type Order = tuple[
    int, bool, bool, Text, int, list[int], Text, int, str, float, str, bool, tuple[str, ...]
]


def order(condition: Condition) -> Order:
    """Return the sort key of a condition in tables.

    Conditions are ordered by task. Within a task trained policies come first, by encoder, views and
    everything else, then the references. Numbers in names are ordered by value: 3 minutes before
    10.
    """
    known = view_names()
    views = [known.index(view) if view in known else len(known) for view in condition.views]
    tasks = task_names()
    task = tasks.index(condition.task) if condition.task in tasks else len(tasks)
    return (
        task,
        not condition.trained,
        not views,
        _by_number(condition.encoder),
        len(views),
        views,
        _by_number(condition.variant),
        condition.demonstrations or 0,
        condition.axis,
        condition.strength,
        condition.expert_swap,
        condition.upset,
        condition.details,
    )


def _by_number(text: str) -> Text:
    """Return a text's pieces, each as the text before a number, and the number."""
    pieces = re.findall(r"(\D*)(\d+(?:\.\d+)?|$)", text)
    return tuple((before, float(number or 0)) for before, number in pieces)
