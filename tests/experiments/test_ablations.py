"""Ablations, banks of starts and randomisation in a grid."""

import json
from dataclasses import fields, replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from surgicai_vision.commands.sweep import read_grid
from surgicai_vision.core import names
from surgicai_vision.core.banks import BANKS
from surgicai_vision.core.config import RandomisationConfig, read_changes
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.experiments.sweep.driver import run_sweep
from surgicai_vision.experiments.sweep.grid import Ablation, Grid
from surgicai_vision.experiments.sweep.plan import Jobs, plan, run_key
from surgicai_vision.training import policies
from surgicai_vision.training.checkpoint import read_checkpoint
from surgicai_vision.training.run_config import RunConfig, with_epochs

BASE = """
task: grasp
encoder: random-conv
view: ["front,back"]
recipe: best
frame_stride: 5
demonstrations: 4
proprioception: true
"""


def write(path, *lines):
    path.write_text("\n".join([BASE, *lines]))
    return path


@pytest.fixture
def ablated(tmp_path):
    """A grid of a run with images, one without, and five ablations."""
    ablations = [
        "ablation:",
        "  - view: front",
        "  - {view: [front, wrist_psm2]}",
        "  - change: clock=false,proprioception=false",
        "  - {demonstrations: 2}",
        "  - {pool: spatial}",
    ]
    return read_grid(write(tmp_path / "grid.yaml", *ablations))


def test_an_ablation_replaces_one_thing_in_the_runs_that_see(ablated):
    whole, blind, *rest = ablated.runs
    assert blind.encoder is None and len(rest) == len(ablated.ablation) == 5
    changed = [
        {
            item.name
            for item in fields(RunConfig)
            if getattr(run, item.name) != getattr(whole, item.name)
        }
        for run in rest
    ]
    assert changed == [{"views"}, {"views"}, {"changes"}, {"demonstrations"}, {"pool"}]
    assert ablated.views == ("front", "back", "wrist_psm2"), "what some ablation sees is rendered"
    assert len({run_key(run) for run in ablated.runs}) == 7
    assert rest[2].name.endswith("best+clock=false+proprioception=false")


def test_ablations_share_the_features_they_have_in_common(ablated, tmp_path):
    jobs = Jobs(ablated, tmp_path)
    made = {job.key() for run in ablated.runs for job in jobs.features(run)}
    assert len(made) == 3 + 2, "three views of the whole, and two of the other pool"
    assert jobs.features(ablated.runs[0])[0].arguments["run"]["changes"] == ["frame_stride=5"], (
        "thinned as the recipe says"
    )


def test_a_change_reaches_the_recipe(ablated):
    recipes = [policies.recipe_of(run) for run in ablated.runs]
    assert (recipes[0].clock, recipes[0].proprioception) == (True, True)
    assert (recipes[4].clock, recipes[4].proprioception) == (False, False)
    assert recipes[4] == replace(recipes[0], clock=False, proprioception=False)
    assert read_changes(("a=1", "b=[1, 2]", "c=x", "d=false")) == {
        "a": 1,
        "b": [1, 2],
        "c": "x",
        "d": False,
    }
    for wrong in (("clock",), ("=1",), ("a=1", "a=2"), ("a=[",)):
        with pytest.raises(InputError, match="change"):
            read_changes(wrong)
    with pytest.raises(InputError, match="Did you mean 'clock'"):
        policies.load_recipe("bc", "best", read_changes(("clokc=false",)))


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("ablation: [{}]", "replaces nothing"),
        ("ablation: [{demonstrations: 5}]", "allowed: 1 to 4"),
        ("ablation: [{encoder: rondom-conv}]", "Did you mean 'random-conv'"),
        ("ablation: [{recipe: best}]", "2 of them different"),
        ("ablation: [{seed: 3}]", "Unknown key"),
        ("starts: vlidation", "Did you mean 'validation'"),
        ("randomisation: {phantom_shift: 50}", "phantom_shift is 50"),
    ],
)
def test_a_wrong_ablation_bank_or_randomisation_is_refused(tmp_path, line, told):
    with pytest.raises(InputError, match=told):
        read_grid(write(tmp_path / "grid.yaml", line))


def test_banks_are_the_starts_of_their_names():
    assert dict(BANKS) == {"test": names.TEST_SEED, "validation": names.VALIDATION_SEED}
    run = RunConfig(encoder="random", views=("front",), changes=("epochs=3",))
    assert Ablation(pool="spatial").of(run) == replace(run, pool="spatial")
    assert Ablation(change=("clock=true",)).of(run).changes == ("epochs=3", "clock=true")


def test_a_randomised_grid_demonstrates_and_evaluates_in_that_world(tmp_path):
    axes = RandomisationConfig(phantom_shift=4.0)
    grid = Grid(
        ("place",), (), (), proprioception=True, demonstrations=(2,), epochs=1, episodes=2, size=32
    )
    moving = replace(grid, randomisation=axes, starts="validation")
    out = tmp_path / "out"
    result = run_sweep(moving, out, RunContext(0))
    assert (result["done"], result["failed"]) == (1, 0), result["problems"]
    (state,) = plan(moving, out)
    assert read_checkpoint(out / "runs" / state.key / "policy").task.randomisation == axes
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    assert [row["seed"] for row in rows] == [names.VALIDATION_SEED, names.VALIDATION_SEED + 1]
    for folder in (out / "references/expert-place", out / "runs" / state.key / "evaluation"):
        stored = json.loads((folder / "evaluation.json").read_text())
        assert stored["run"]["env"]["randomisation"]["phantom_shift"] == 4.0
    meta = json.loads((out / "data/place/dataset/meta/surgicai.json").read_text())
    assert np.isclose(meta["task_config"]["randomisation"]["phantom_shift"], 4.0)
    assert {run_key(run) for run in grid.runs}.isdisjoint(run_key(run) for run in moving.runs)


def test_there_is_one_way_to_change_a_recipe():
    run = RunConfig(changes=with_epochs(("clock=true",), 3), privileged=False)
    recipe = policies.recipe_of(run)
    assert (recipe.epochs, recipe.clock, recipe.privileged) == (3, True, False)
    assert policies.recipe_of(RunConfig(privileged=True)).privileged
    assert policies.recipe_of(RunConfig()) == policies.load_recipe("bc", "paper")
