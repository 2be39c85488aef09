"""Ablations, banks of starts and randomisation in a grid: one thing replaced at a time, and
evaluated where it says.
"""

import json
from dataclasses import fields, replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.commands.sweep import read_grid
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, read_changes
from surgicai_vision.core.errors import InputError
from surgicai_vision.experiments.run import Cell
from surgicai_vision.experiments.sweep import Grid, plan, run_sweep
from surgicai_vision.experiments.sweep.grid import BANKS, Ablation
from surgicai_vision.experiments.sweep.plan import Jobs
from surgicai_vision.training import policies
from surgicai_vision.training.checkpoint import read_checkpoint

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
    """A cell that sees, one that does not, and five ablations."""
    ablations = [
        "ablation:",
        "  - view: front",
        "  - {view: [front, wrist_psm2]}",
        "  - change: clock=false,proprioception=false",
        "  - {demonstrations: 2}",
        "  - {pool: spatial}",
    ]
    return read_grid(write(tmp_path / "grid.yaml", *ablations))


def test_a_lever_replaces_one_thing_in_the_cells_that_see(ablated):
    whole, blind, *rest = ablated.cells
    assert blind.encoder is None and len(rest) == len(ablated.ablation) == 5
    for cell, ablation in zip(rest, ablated.ablation, strict=True):
        changed = {
            item.name
            for item in fields(Cell)
            if getattr(cell, item.name) != getattr(whole, item.name)
        }
        assert changed == set(ablation.replaced) and len(changed) == 1
    assert ablated.views == ("front", "back", "wrist_psm2"), "what some ablation sees is rendered"
    assert len({ablated.key(cell) for cell in ablated.cells}) == 7
    assert rest[2].name.endswith("best+clock=false+proprioception=false")


def test_levers_share_the_features_they_have_in_common(ablated, tmp_path):
    jobs = Jobs(ablated, tmp_path)
    made = {job.key() for cell in ablated.cells for job in jobs.features(cell)}
    assert len(made) == 3 + 2, "three views of the whole, and two of the other pool"
    assert jobs.features(ablated.cells[0])[0].arguments["cell"]["change"] == ["frame_stride=5"], (
        "thinned as the recipe says"
    )


def test_a_change_reaches_the_recipe(ablated):
    recipes = [policies.load_recipe("bc", cell.recipe, cell.changes) for cell in ablated.cells]
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
def test_a_wrong_lever_bank_or_randomisation_is_refused(tmp_path, line, told):
    with pytest.raises(InputError, match=told):
        read_grid(write(tmp_path / "grid.yaml", line))


def test_banks_are_the_starts_of_their_names():
    assert dict(BANKS) == {"test": names.TEST_SEED, "validation": names.VALIDATION_SEED}
    assert Ablation(pool="spatial").replaced == {"pool": "spatial"}


def test_a_randomised_grid_demonstrates_and_evaluates_in_that_world(tmp_path):
    axes = RandomisationConfig(phantom_shift=4.0)
    grid = Grid(
        ("place",), (), (), proprioception=True, demonstrations=(2,), epochs=1, episodes=2, size=32
    )
    moving = replace(grid, randomisation=axes, starts="validation")
    out = tmp_path / "out"
    result = run_sweep(moving, out, QuietConsole().stage, 0)
    assert (result["done"], result["failed"]) == (1, 0), result["problems"]
    (state,) = plan(moving, out)
    assert read_checkpoint(out / "cells" / state.key / "policy").task.randomisation == axes
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    assert [row["seed"] for row in rows] == [names.VALIDATION_SEED, names.VALIDATION_SEED + 1]
    for folder in (out / "references/expert-place", out / "cells" / state.key / "evaluation"):
        stored = json.loads((folder / "evaluation.json").read_text())
        assert stored["about"]["task_config"]["randomisation"]["phantom_shift"] == 4.0
    meta = json.loads((out / "data/place/dataset/meta/surgicai.json").read_text())
    assert np.isclose(meta["task_config"]["randomisation"]["phantom_shift"], 4.0)
    assert {grid.key(cell) for cell in grid.cells}.isdisjoint(
        moving.key(cell) for cell in moving.cells
    )
