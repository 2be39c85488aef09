"""A run records the world that its policy learned in, and reports distinguish such policies."""

import itertools
from dataclasses import replace

import pytest

from surgicai_vision.core.config import (
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
    from_mapping,
    to_identity,
    to_mapping,
)
from surgicai_vision.evaluation.policy_spec import PolicySpec, in_env
from surgicai_vision.evaluation.robustness import shifted
from surgicai_vision.report.experiment_key import USUAL, condition_of, labels
from surgicai_vision.report.pairs import factor
from surgicai_vision.training.run_config import RunConfig, evaluated_in, of_training

STANDING = TaskConfig("insert")
MOVED = replace(STANDING, randomisation=RandomisationConfig(phantom_shift=10, kinematic_error=0.25))
SOFT = replace(STANDING, scene=SceneConfig(tissue="soft"))
WORLDS = (STANDING, MOVED, SOFT)


def trained(env):
    return RunConfig(env, "imagenet-lite", ("back",), demonstrations=50)


@pytest.mark.parametrize(("home", "first", "last"), [*itertools.product(WORLDS, repeat=3)])
def test_what_a_run_remembers_does_not_depend_on_where_it_was_before(home, first, last):
    run = trained(home)
    once = evaluated_in(run, last)
    assert evaluated_in(evaluated_in(run, first), last) == once
    assert once.env == last and once.recorded_in == (None if last == home else home)
    assert of_training(once) == run
    assert from_mapping(RunConfig, to_mapping(once)) == once


def test_a_run_at_home_is_known_as_it_always_was():
    run = trained(MOVED)
    assert evaluated_in(run, MOVED) == run and "recorded_in" not in to_identity(run)
    # A change outside the world is not another world.
    longer = replace(MOVED, max_steps=300)
    assert evaluated_in(run, longer).recorded_in is None
    expert = RunConfig(STANDING, policy="expert")
    assert evaluated_in(expert, MOVED).recorded_in is None


def test_policies_of_two_worlds_are_told_apart_where_they_meet():
    here, there = (condition_of(evaluated_in(trained(home), MOVED)) for home in (STANDING, MOVED))
    assert here != there
    assert here.recorded_in == USUAL and not there.recorded_in
    assert factor(here, there) == "world of the demonstrations"
    assert USUAL in here.label and "phantom_shift 10" in there.label


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"post_success_steps": 20}, "steps after success"),
        ({"recipe": "mine/paper.yaml"}, "recipe"),
        ({"updates": 2000, "batch_size": 64}, "budget"),
    ],
)
def test_what_was_taught_otherwise_is_another_condition(changes, difference):
    run = replace(trained(STANDING), updates=changes.get("updates"), batch_size=8)
    one, other = condition_of(run), condition_of(replace(run, **changes))
    assert factor(one, other) == difference
    assert len(set(labels([one, other]).values())) == 2


def test_one_policy_in_two_worlds_is_paired_and_two_policies_in_two_worlds_are_not():
    home, away = (
        condition_of(evaluated_in(trained(STANDING), world)) for world in (STANDING, SOFT)
    )
    assert factor(home, away) == "world"
    assert factor(home, condition_of(trained(SOFT))) == ""
    # In a plan the condition's name identifies the world.
    named = [replace(item, name=name) for item, name in ((home, "a"), (away, "b"))]
    assert factor(*named) == "condition" and "tissue soft" not in named[1].label
    assert factor(named[0], replace(condition_of(trained(SOFT)), name="b")) == ""


@pytest.mark.parametrize("home", [STANDING, MOVED])
def test_what_is_shifted_is_the_same_policy_at_every_strength(home):
    spec = PolicySpec(trained(home), lambda: None)
    plain = condition_of(spec.run)
    for axis, strength in itertools.product(("camera", "blur", "all"), (0.0, 0.5)):
        run = shifted(spec, axis, strength).run
        assert run.recorded_in == home and run.shift.strength == strength
        assert replace(condition_of(run), axis="", strength=0.0) == plain


def test_a_table_of_the_env_moves_a_policy_as_a_plan_does():
    spec = PolicySpec(trained(STANDING), lambda: None)
    table = {"randomisation": {"phantom_shift": 10, "kinematic_error": 0.25}}
    moved = in_env(spec, table).run
    assert moved == evaluated_in(spec.run, moved.env) and moved.recorded_in == STANDING
