"""Dependence in the report: which numbers of the randomisation failures depend on."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
from sweep_results import CHECKPOINT, MACHINE, episode, run_of
from test_report import painted_stage

from surgicai_vision import report
from surgicai_vision.core import names
from surgicai_vision.core.config import RANDOMISATION_LIMITS, RandomisationConfig, TaskConfig
from surgicai_vision.envs import contact_sheet, randomisation
from surgicai_vision.evaluation.storage import write_evaluation
from surgicai_vision.report.dependence import QUANTITIES, dependences, quantities, rows
from surgicai_vision.report.groups import group
from surgicai_vision.report.reader import collect
from surgicai_vision.training.run_config import Starts

WORLD = RandomisationConfig(
    phantom_shift=10, pair="any", needle_size=0.16, needle_arc="train", robot_start=15, light=0.2
)
STARTS = 60


def store(folder, succeeds, *, seeds=(0,), world=WORLD):
    """Store an evaluation per training seed; `succeeds(seed)` says which starts succeed."""
    for training_seed in seeds:
        config = TaskConfig("grasp", randomisation=world)
        run = replace(run_of("grasp", "imagenet", ("back",), training_seed), env=config)
        run = replace(run, starts=Starts(names.TEST_SEED, STARTS))
        generator = np.random.default_rng(0)
        made = [
            episode("grasp", run.name, seed, bool(succeeds(seed)), generator)
            for seed in range(names.TEST_SEED, names.TEST_SEED + STARTS)
        ]
        about = {"command": "evaluate", "provenance": MACHINE, "checkpoint": CHECKPOINT}
        write_evaluation(folder / str(training_seed), made, run, about)
    return folder


def radius(seed):
    """How far the needle's radius is off [%]."""
    return 100 * float(randomisation.drawn(WORLD, seed)["needle_size"][0])


def by_quantity(folder):
    """Quantity → its dependence."""
    return {item.quantity: item for item in dependences(group(collect(folder)))}


def test_failures_of_small_needles_depend_on_the_radius(tmp_path):
    found = by_quantity(store(tmp_path, lambda seed: radius(seed) > -6))
    starts = range(names.TEST_SEED, names.TEST_SEED + STARTS)
    thirds = np.array_split(sorted(radius(seed) for seed in starts), 3)
    parts = found["needle radius"].parts
    assert [part.name for part in parts] == [f"{t[0]:.2g} to {t[-1]:.2g} %" for t in thirds]
    assert [part.successes for part in parts] == [int(sum(t > -6)) for t in thirds]
    assert all(part.episodes == STARTS // 3 for part in parts)
    assert found["needle radius"].adjusted < 0.01
    assert all(item.adjusted > 0.05 for name, item in found.items() if name != "needle radius")
    (row,) = rows(list(found.values()))
    assert (row[0], row[2]) == ("grasp", "needle radius")


def test_choices_divide_the_starts_by_what_was_chosen(tmp_path):
    drawn = {
        seed: int(randomisation.drawn(WORLD, seed)["pair"][0])
        for seed in range(names.TEST_SEED, names.TEST_SEED + STARTS)
    }
    found = by_quantity(store(tmp_path, lambda seed: drawn[seed] != 3))
    counts = {part.name: (part.successes, part.episodes) for part in found["pair of holes"].parts}
    pairs = list(drawn.values())
    assert counts == {
        str(pair): (0 if pair == 3 else pairs.count(pair), pairs.count(pair))
        for pair in (1, 2, 3, 4)
    }
    assert {part.name for part in found["needle arc"].parts} == {"1/3", "1/2"}


def test_a_start_counts_once_however_many_training_seeds_there_are(tmp_path):
    one = by_quantity(store(tmp_path / "one", lambda seed: radius(seed) > -6))
    three = by_quantity(store(tmp_path / "three", lambda seed: radius(seed) > -6, seeds=(0, 1, 2)))
    for name, item in three.items():
        assert item.p == one[name].p
        assert [part.episodes for part in item.parts] == [
            3 * part.episodes for part in one[name].parts
        ]


def test_what_failures_do_not_depend_on_is_said(tmp_path):
    found = by_quantity(store(tmp_path, lambda seed: np.random.default_rng(seed).random() < 0.7))
    ((*_, words, _, p),) = rows(list(found.values()))
    assert words.startswith(f"none of {len(found)}; nearest: ")
    assert float(p.strip("< ")) >= 0.05


@pytest.mark.parametrize("failures", [0, 4, STARTS - 4])
def test_few_failures_or_successes_say_nothing(tmp_path, failures):
    assert not by_quantity(store(tmp_path, lambda seed: seed - names.TEST_SEED >= failures))


def test_without_randomisation_there_is_nothing_to_depend_on(tmp_path):
    store(tmp_path, lambda seed: seed % 2, world=RandomisationConfig())
    assert not by_quantity(tmp_path)


def test_every_axis_that_is_drawn_is_measured():
    everything = RandomisationConfig(
        **dict.fromkeys(("latency", "distractors"), 1),
        **{
            axis: 0.5 * limit
            for axis, limit in RANDOMISATION_LIMITS.items()
            if axis not in ("latency", "distractors", "appearance_shift")
        },
        pair="any",
        needle_arc="train",
        appearance="train",
    )
    drawn = randomisation.drawn(everything, 7)
    measured = quantities(everything)
    assert drawn.keys() - measured.keys() == {"latency"}  # the same in every episode
    assert measured.keys() >= QUANTITIES.keys()
    for axis, found in measured.items():
        for quantity in found:
            value = quantity.of(np.atleast_1d(drawn[axis]))
            assert isinstance(value, float if quantity.unit else str)
            if quantity.unit == "%":
                assert 0 < abs(value) <= 100


def test_the_page_and_a_table_have_them(tmp_path, monkeypatch):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    folder = store(tmp_path, lambda seed: radius(seed) > -6)
    page = report.write_report(folder, strips=0).read_text()
    section = page.split('id="dependence"')[1].split("<h2")[0]
    assert "needle radius" in re.sub("<[^>]+>", "", section)
    with open(folder / "tables/dependence.csv", newline="") as file:
        records = list(csv.DictReader(file))
    parts = [part for item in by_quantity(folder).values() for part in item.parts]
    assert [(row["part"], int(row["successes"]), int(row["episodes"])) for row in records] == [
        (part.name, part.successes, part.episodes) for part in parts
    ]
