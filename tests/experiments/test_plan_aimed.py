"""Conditions of a plan whose crops a detector aims, tiny, end to end."""

import json

import pytest

from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.detection.card import RELEASED, detector_folder, read_card
from surgicai_vision.evaluation.storage import read_evaluation
from surgicai_vision.experiments.plan_config import plan_of
from surgicai_vision.experiments.sweep.driver import run_sweep
from surgicai_vision.experiments.sweep.plan import plan, run_key
from surgicai_vision.report import collect
from surgicai_vision.report.groups import group
from surgicai_vision.report.pairs import compare

CAMERA = {"axis": "camera", "strength": 0.5}
TABLE = {
    "size": 32,
    "encoder": "random-conv",
    "pool": "spatial",
    "recipe": "unmoved",
    "episodes": 1,
    "epochs": 1,
    "demonstrations": [{"name": "few", "task": "place", "episodes": 2, "view": ["front_psm2"]}],
    "policies": [{"name": "place", "demonstrations": "few", "view": ["front_psm2"]}],
    "conditions": [
        {"name": "as reported", "shift": CAMERA, "env": {"max_steps": 6}},
        {"name": "aimed", "shift": CAMERA, "aimed": True, "env": {"max_steps": 6}},
    ],
}


def test_an_aimed_condition_is_evaluated_with_the_released_detector(tmp_path):
    built = plan_of(TABLE, "a test")
    out = tmp_path / "out"
    result = run_sweep(built, out, RunContext(0, stage=QuietConsole().stage))
    assert (result["done"], result["failed"]) == (2, 0), result["problems"]
    stored = {}
    for state in plan(built, out):
        run = read_evaluation(out / "runs" / state.key / "evaluation").run
        stored[run.condition] = run
    found = read_card(detector_folder(RELEASED)).weights_sha256
    assert (stored["as reported"].detector, stored["aimed"].detector) == ("", found)
    assert f"aimed-{found[:8]}" in stored["aimed"].name
    groups = group(collect(out))
    labels = sorted(item.label for item in groups)
    assert [f"aimed by detector {found[:8]}" in label for label in labels] == [False, True]
    assert {pair.factor for pair in compare(groups)} == {"condition"}


def test_a_condition_without_a_detector_keeps_its_key():
    plain = {**TABLE, "conditions": TABLE["conditions"][:1]}
    keys = {run.condition: run_key(run) for run in plan_of(TABLE, "a test").runs}
    assert [run_key(run) for run in plan_of(plain, "a test").runs] == [keys["as reported"]]
    assert keys["aimed"] != keys["as reported"]


def test_a_sweep_stored_before_conditions_could_be_aimed_is_continued():
    plain = plan_of({**TABLE, "conditions": TABLE["conditions"][:1]}, "a test")
    stored = json.loads(json.dumps(plain.table()))
    for condition in stored["conditions"]:
        del condition["aimed"]
    assert plan_of(TABLE, "a test").extends(stored)
    assert not plan_of({**TABLE, "size": 64}, "a test").extends(stored)


def test_whole_images_cannot_be_aimed():
    table = {
        **TABLE,
        "demonstrations": [{**TABLE["demonstrations"][0], "view": ["front"]}],
        "policies": [{**TABLE["policies"][0], "view": ["front"]}],
    }
    with pytest.raises(InputError, match="'place' sees front"):
        plan_of(table, "a test")
