"""Checks of a plan: what is refused before any work; see `plan_config`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from surgicai_vision.core import names
from surgicai_vision.core.banks import BANKS
from surgicai_vision.core.config import JSON, TaskConfig, to_mapping
from surgicai_vision.core.errors import InputError, check_at_least, check_name
from surgicai_vision.evaluation.hierarchical_config import HLP
from surgicai_vision.evaluation.robustness.axes import SHIFTS
from surgicai_vision.experiments.dataset_config import (
    MOST_EPISODES,
    SEEDS_EACH,
    Demonstrations,
    first_seed,
)
from surgicai_vision.experiments.plan_parts import PARTS, Condition, PlannedPolicy
from surgicai_vision.features import encoders
from surgicai_vision.training.policies import POLICIES
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
    for what, named in (
        ("demonstrations", plan.demonstrations),
        ("policies", plan.policies),
        ("conditions", plan.conditions),
    ):
        for each in named:
            _check_folder_name(what, each.name)
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
        _check_built_on(plan, recorded)
    for policy in plan.policies:
        _check_policy(plan, policy)
    _check_parts(plan)
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
    visited = next(each for each in plan.demonstrations if each.name == recorded.visits_of)
    limit = TaskConfig(recorded.task).max_steps  # a visit's, as `demos.cut` gives it
    visit = replace(plan.recorded_env(visited, recorded.task), max_steps=limit)
    _check_same_env(recorded, plan.recorded_env(recorded), visited, visit)


def _check_same_env(
    recorded: Demonstrations, env: TaskConfig, other: Demonstrations, theirs: TaskConfig
) -> None:
    """Refuse to render demonstrations of two envs into one dataset."""
    if env != theirs:
        raise InputError(
            f"demonstrations {recorded.name}: they are rendered with those of '{other.name}', so "
            "both need the same task, env and step limit; give both the same env, without "
            "max_steps where visits are cut."
        )


def _check_looks(plan: "Plan", recorded: Demonstrations) -> None:
    """Refuse to render looks that are held out for tests: no policy may learn from them."""
    shown = recorded.shown(plan.recorded_env(recorded))
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


def _check_built_on(plan: "Plan", recorded: Demonstrations) -> None:
    """Refuse to build on demonstrations in which a learner acts: none acts where they are made."""
    for each in plan.demonstrations:
        if each.learner and each.name in (recorded.of, recorded.visits_of):
            raise InputError(
                f"demonstrations {recorded.name}: '{each.name}', which they build on (of or "
                f"visits_of), has a learner, '{each.learner}'; name demonstrations without one."
            )


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
    before = plan.recorded(policies[recorded.learner])
    _check_same_env(recorded, plan.recorded_env(recorded), before, plan.recorded_env(before))
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


def _check_parts(plan: "Plan") -> None:
    """Refuse a policy that cannot do its part of the whole procedure.

    A policy called like a part need not do it where there is no whole procedure.
    """
    parts = plan.suture if names.SUTURE in plan.names else {}
    given = {policy.part: policy for policy in plan.policies if policy.part}
    for part, policy in {**parts, **given}.items():
        is_ours = POLICIES.is_ours(policy.policy)  # what others do is known when it is trained
        if is_ours and (policy.policy == HLP) != (part == HLP):
            raise InputError(
                f"policies: '{policy.name}' is to do the part '{part}', and its policy is "
                f"'{policy.policy}'; '{HLP}' does the part '{HLP}', and no other."
            )
        task = policy.subtask or plan.recorded(policy).task
        if part not in (HLP, task):
            raise InputError(
                f"policies: '{policy.name}' is to do the part '{part}', and it is trained on "
                f"'{task}'; name demonstrations of '{part}', or give subtask: {part}."
            )


def _check_condition(plan: "Plan", condition: Condition) -> None:
    """Refuse a condition for what is not trained, or that no env or procedure accepts."""
    evaluated = [policy.name for policy in plan.policies if policy.acts]
    plan.hierarchical(condition, {})
    if names.SUTURE in plan.names:
        evaluated.append(names.SUTURE)
    for name in condition.policies:
        check_name("policy that is evaluated", name, evaluated)
    for seed in condition.seed:
        check_name("training seed", str(seed), [str(seed) for seed in plan.seed])
    check_at_least(1, **{f"condition {condition.name}: episodes": condition.episodes})
    _check_env(f"condition {condition.name}", {**plan.env, **condition.env}, "evaluated")
    plan.task_config(names.SUTURE, condition)
    if condition.aimed:
        unless_named = [name for name in evaluated if name in plan.names]
        for name in condition.policies or unless_named:
            acting = plan.suture.values() if name == names.SUTURE else (plan.policy(name),)
            views = [view for policy in acting for view in policy.view]
            if set(names.CROPS).isdisjoint(views) or any(map(names.is_depth_view, views)):
                raise InputError(
                    f"condition {condition.name}: a detector aims crops in colour, and '{name}' "
                    f"sees {', '.join(views) or 'no images'}; name policies that see crops, or "
                    "leave aimed out."
                )
    if condition.shift is not None:
        check_name("axis", condition.shift.axis, SHIFTS)
        if not 0 <= condition.shift.strength <= 1:
            raise InputError(
                f"condition {condition.name}: strength is {condition.shift.strength}; "
                "allowed: 0 to 1."
            )


def _check_runs(plan: "Plan") -> None:
    """Refuse policies whose runs are equal: the results of one would stand for the other's.

    Policies that are the same but for names are one: their results are the same.
    """
    evaluated: dict[RunConfig, str] = {}
    for run, name, _ in plan.evaluations():
        first = evaluated.setdefault(run, name)
        if first != name and _learned(plan, first) != _learned(plan, name):
            raise InputError(
                f"policies '{first}' and '{name}' have the same run, which records neither their "
                "names nor everything about their demonstrations (jaw_noise, upset_fraction, "
                "late, …); evaluate one of them in another plan."
            )


def _learned(plan: "Plan", name: str) -> JSON:
    """Return what a policy is trained on as plain data, without the names of demonstrations."""
    policy = plan.policy(name)
    dataset = plan.dataset(plan.recorded(policy), plan.seed[0])
    return [policy.subtask, _unnamed(to_mapping(dataset))]


def _unnamed(table: JSON) -> JSON:
    """Return plain data of a dataset without the names of demonstrations."""
    if not isinstance(table, dict):
        return table
    called = ("name", "of", "visits_of")
    return {key: _unnamed(value) for key, value in table.items() if key not in called}


def _check_folder_name(what: str, name: str) -> None:
    """Refuse a name that cannot be a folder's, and that of the whole procedure for a policy."""
    if not name or name.startswith(".") or "/" in name or "\0" in name:
        raise InputError(
            f"{what}: a name is '{name}'; folders have these names, so give at least one "
            "character, none of them '/', and no '.' at the beginning."
        )
    if (what, name) == ("policies", names.SUTURE):
        raise InputError(
            f"policies: '{name}' is the whole procedure by all its parts; give the policy another "
            "name."
        )


def _check_different(what: str, values: Sequence[object]) -> None:
    """Refuse an empty list, and a value that is given twice."""
    if not values or len(set(values)) != len(values):
        raise InputError(
            f"{what}: {', '.join(map(str, values)) or 'nothing'} is given; "
            "give at least one, each once."
        )
