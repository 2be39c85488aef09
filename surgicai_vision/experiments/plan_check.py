"""Checks of a plan: what is refused before any work; see `plan_config`."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from surgicai_vision.core import names
from surgicai_vision.core.banks import BANKS
from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError, check_at_least, check_name
from surgicai_vision.evaluation.hierarchical_config import HLP
from surgicai_vision.evaluation.robustness.axes import AXES
from surgicai_vision.experiments.dataset_config import (
    MOST_EPISODES,
    SEEDS_EACH,
    Demonstrations,
    first_seed,
)
from surgicai_vision.experiments.plan_parts import PARTS, Condition, PlannedPolicy
from surgicai_vision.features import encoders
from surgicai_vision.training.run_config import RunConfig

if TYPE_CHECKING:
    from surgicai_vision.experiments.plan_config import Plan


def check_plan(plan: "Plan") -> None:
    """Refuse a plan that names something it does not contain, or that cannot be run as it says.

    Raises:
        InputError: what is wrong, and what is allowed.
    """
    check_name("bank of starts", plan.starts, BANKS)
    _check_different("demonstrations", [recorded.name for recorded in plan.demonstrations])
    _check_different("policies", [policy.name for policy in plan.policies])
    parts = [policy.part for policy in plan.policies if policy.part]
    if parts:
        _check_different("parts", parts)
    _check_different("conditions", [condition.name for condition in plan.conditions])
    _check_different("seed", plan.seed)
    for seed in plan.seed:
        first_seed(seed)
    check_at_least(1, episodes=plan.episodes, size=plan.size, epochs=plan.epochs)
    for recorded in plan.demonstrations:
        _check_env(f"demonstrations {recorded.name}", recorded.env, "recorded")
        _check_looks(plan, recorded)
        if recorded.episodes > MOST_EPISODES:
            raise InputError(
                f"demonstrations {recorded.name}: episodes is {recorded.episodes}; "
                f"allowed: 1 to {MOST_EPISODES}."
            )
        _check_visits(plan, recorded)
        _check_multiplied(plan, recorded)
    for policy in plan.policies:
        _check_policy(plan, policy)
    for recorded in plan.demonstrations:
        _check_learner(plan, recorded)
    for condition in plan.conditions:
        _check_condition(plan, condition)
    _check_runs(plan)


def _check_env(where: str, env: Mapping[str, JSON], done: str) -> None:
    """Refuse fields of an env that a file may not set."""
    for key in ("task", "advance"):
        if key in env:
            raise InputError(
                f"{where}: env has '{key}', which follows from what is {done}; leave it out."
            )


def _check_visits(plan: "Plan", recorded: Demonstrations) -> None:
    """Refuse visits of a task that is no subtask, or in anything but whole procedures."""
    if not recorded.visits_of:
        return
    whole = [each.name for each in plan.demonstrations if each.task == names.SUTURE]
    check_name("demonstrations of the whole procedure", recorded.visits_of, whole)
    check_name("task that is visited", recorded.task, names.SUBTASKS)


def _check_looks(plan: "Plan", recorded: Demonstrations) -> None:
    """Refuse to render looks that are held out for tests: no policy may learn from them."""
    env = plan.recorded_env(recorded)
    shown = recorded.looks.shown(env) if recorded.looks else env
    if recorded.view and shown.randomisation.shows_heldout:
        raise InputError(
            f"demonstrations {recorded.name} would show looks that are held out for tests "
            f"({', '.join(names.HELDOUT_APPEARANCES)}); use appearance: {names.TRAIN} and no "
            "appearance_shift; a condition may show them."
        )


def _check_multiplied(plan: "Plan", recorded: Demonstrations) -> None:
    """Refuse to re-pose demonstrations of another task, and multiplied ones."""
    if not recorded.of:
        return
    first = [
        each.name for each in plan.demonstrations if each.task == recorded.task and not each.of
    ]
    check_name(f"demonstrations of {recorded.task} that are not multiplied", recorded.of, first)


def _check_learner(plan: "Plan", recorded: Demonstrations) -> None:
    """Refuse a learner of another task, or one trained on the demonstrations it acts in."""
    policies = {policy.name: policy for policy in plan.policies}
    behind = [recorded.name]
    learner = recorded.learner
    while learner:
        acting = [
            policy.name
            for policy in plan.policies
            if policy.policy != HLP
            and (policy.subtask or plan.recorded(policy).task) == recorded.task
        ]
        check_name(f"policy that acts in {recorded.task}", learner, acting)
        learned = plan.recorded(policies[learner])
        if learned.name in behind:
            raise InputError(
                f"demonstrations {recorded.name}: its learner '{recorded.learner}' is trained on "
                f"'{learned.name}', which is recorded with that learner; give one that is "
                "trained earlier."
            )
        behind.append(learned.name)
        learner = learned.learner
    if not recorded.learner:
        return
    first = plan.dataset(recorded, plan.seed[0])
    if first.next_seed > first_seed(plan.seed[0]) + SEEDS_EACH:
        raise InputError(
            f"demonstrations {recorded.name}: with those that its learner was trained on, they try "
            f"more than the {SEEDS_EACH} starts of a training seed; record fewer episodes."
        )


def _check_policy(plan: "Plan", policy: PlannedPolicy) -> None:
    """Refuse a policy whose demonstrations are not recorded, or whose views are not rendered."""
    known = [recorded.name for recorded in plan.demonstrations]
    check_name("demonstrations", policy.demonstrations, known)
    if policy.subtask is not None:
        check_name("subtask", policy.subtask, names.SUBTASKS)
    for view in policy.view:
        check_name("rendered view", view, plan.recorded(policy).view)
    if policy.part:
        check_name("part of the whole procedure", policy.part, PARTS)
    encoders.check_encoder_name(policy.encoder or plan.encoder)


def _check_condition(plan: "Plan", condition: Condition) -> None:
    """Refuse a condition for what is not trained, or that no env or procedure accepts."""
    evaluated = [policy.name for policy in plan.policies if policy.acts]
    if names.SUTURE in plan.names:
        evaluated.append(names.SUTURE)
        plan.hierarchical(condition, {})
    for name in condition.policies:
        check_name("policy that is evaluated", name, evaluated)
    for seed in condition.seed:
        check_name("training seed", str(seed), [str(seed) for seed in plan.seed])
    check_at_least(1, **{f"condition {condition.name}: episodes": condition.episodes})
    _check_env(f"condition {condition.name}", {**plan.env, **condition.env}, "evaluated")
    plan.task_config(names.SUTURE, condition)
    if condition.aimed:
        for name in condition.policies or evaluated:
            acting = plan.suture.values() if name == names.SUTURE else (plan.policy(name),)
            for policy in acting:
                for view in policy.view:
                    check_name("crop that a detector can aim", view, names.CROPS)
    if condition.shift is not None:
        check_name("axis", condition.shift.axis, AXES)
        if not 0 <= condition.shift.strength <= 1:
            raise InputError(
                f"condition {condition.name}: strength is {condition.shift.strength}; "
                "allowed: 0 to 1."
            )


def _check_runs(plan: "Plan") -> None:
    """Refuse policies whose runs are equal: the results of one would stand for the other's."""
    evaluated: dict[RunConfig, str] = {}
    for run, name, _ in plan.evaluations():
        first = evaluated.setdefault(run, name)
        if first != name:
            raise InputError(
                f"policies '{first}' and '{name}' have the same run, which records neither their "
                "names nor everything about their demonstrations (jaw_noise, upset_fraction, "
                "late, …); evaluate one of them in another plan."
            )


def _check_different(what: str, values: Sequence[object]) -> None:
    """Refuse an empty list, and a value that is given twice."""
    if not values or len(set(values)) != len(values):
        raise InputError(
            f"{what}: {', '.join(map(str, values)) or 'nothing'} is given; "
            "give at least one, each once."
        )
