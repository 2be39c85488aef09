"""The yardstick: a plan whose rows share starts, and which lists what cannot be run."""

from dataclasses import replace
from pathlib import Path

import pytest

from policies.chunks import ChunkRecipe
from surgicai_vision.commands.sweep import grid_file, read_experiment
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.experiments.plan_config import Condition, NotRun, Plan, plan_of
from surgicai_vision.experiments.sweep.plan import NOT_RUN, TO_DO, plan
from surgicai_vision.training.policies import recipe_of
from surgicai_vision.training.run_config import OWN, Shift

POLICIES = ("act", "diffusion", "vqbet", "bc")


@pytest.fixture(scope="module")
def yardstick() -> Plan:
    experiment = read_experiment(grid_file("yardstick"))
    assert isinstance(experiment, Plan)
    return experiment


def test_every_task_has_every_policy_clean_and_shifted(yardstick: Plan) -> None:
    can_run = [run for run in yardstick.runs if not yardstick.needs(run)]
    assert len(can_run) == len(names.SUBTASKS) * (3 + 3) * 2 * 2, "two conditions, two seeds"
    assert len({run.starts for run in can_run}) == 1 and can_run[0].starts.episodes == 100
    for task in names.SUBTASKS:
        of_task = [run for run in can_run if run.task == task]
        assert {run.policy for run in of_task} == set(POLICIES)
        assert {run.recipe for run in of_task} == {*POLICIES[:3], "best", "endoscope", "paper"}
        assert {run.shift for run in of_task} == {None, Shift("all", 0.5)}
        # A policy is trained once for both conditions.
        assert len({tuple(yardstick.parts(run).values()) for run in of_task}) == len(of_task) / 2


def test_lerobots_policies_have_a_budget_unless_epochs_are_said(yardstick: Plan) -> None:
    trained = {
        part.run
        for run in yardstick.runs
        for part in yardstick.parts(run).values()
        if part.run.policy != "bc"
    }
    for run in trained:
        recipe = recipe_of(run)
        assert isinstance(recipe, ChunkRecipe) and recipe.minutes == 30
        assert not run.by_lerobot_train
        tried = recipe_of(replace(run, changes=(*run.changes[1:], "epochs=2")))
        assert (tried.epochs, tried.minutes) == (2, 0)


def test_what_cannot_be_run_is_listed_with_what_it_needs(yardstick: Plan, tmp_path: Path) -> None:
    states = plan(yardstick, tmp_path / "nowhere")
    assert {state.state for state in states} == {TO_DO, NOT_RUN}
    for state in states:
        listed = state.run.encoder == OWN
        assert (state.state == NOT_RUN) == listed == bool(state.reason)
        if listed:
            assert "GPU" in state.reason and not state.run.shift


def test_a_shift_is_an_axis_and_a_strength(yardstick: Plan) -> None:
    table = dict(yardstick.table())
    for shift, error in (({"axis": "moon", "strength": 1}, UnknownName),):
        with pytest.raises(error):
            plan_of({**table, "conditions": [{"name": "x", "shift": shift}]}, "test")
    with pytest.raises(InputError, match="strength"):
        replace(yardstick, conditions=(Condition("x", shift=Shift("all", 1.5)),))
    more = replace(yardstick, conditions=(*yardstick.conditions, Condition("dark")))
    assert more.extends(yardstick.table())
    assert plan_of(yardstick.table(), "test") == yardstick
    assert NotRun("pi0", ("grasp",), "a GPU").needs == "a GPU"
