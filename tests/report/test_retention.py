"""Retention in the report: bars per axis, the worst axis, held-in against held-out looks."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from sweep_results import CHECKPOINT, evaluation, run_of
from test_report import assert_stands_alone, painted_stage

from surgicai_vision import report
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation import statistics
from surgicai_vision.report.curves import robustness_curves
from surgicai_vision.report.groups import group
from surgicai_vision.report.reader import collect
from surgicai_vision.report.retention import looks, retentions
from surgicai_vision.training.run_config import Shift, evaluated_in

LEFT_AT_ONE = {"light": 1.5, "blur": 0.1, "all": -0.5}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Evaluations of one policy along three axes, and of another in two sets of looks."""
    out = tmp_path_factory.mktemp("retention")
    generator = np.random.default_rng(5)
    about = {"checkpoint": CHECKPOINT}
    for axis, left in LEFT_AT_ONE.items():
        for strength, rate in ((0.0, 1.5), (0.5, 0.5 * (1.5 + left)), (1.0, left)):
            run = run_of("grasp", "imagenet", ("back",), 0, shift=Shift(axis, strength))
            evaluation(out / axis / f"{strength:g}", run, rate, generator, about)
    shown = {
        look: TaskConfig("insert", randomisation=RandomisationConfig(appearance=look))
        for look in (names.TRAIN, names.HELDOUT)
    }
    trained = replace(run_of("insert", "imagenet", ("back",), 0), env=shown[names.TRAIN])
    for look, rate in ((names.TRAIN, 1.5), (names.HELDOUT, 0.5)):
        evaluation(out / "looks" / look, evaluated_in(trained, shown[look]), rate, generator, about)
    return out


def test_bars_say_what_is_left_with_the_worst_axis_first(folder):
    (chart,) = retentions(group(collect(folder)))
    assert [row[0] for row in chart.rows] == ["all", "blur", "light"]
    assert "Worst single axis: blur" in chart.more
    for axis, area, plain, strength, shifted, kept in chart.rows:
        rows = [
            [bool(row["success"]) for result in item.results for row in result.rows]
            for item in sorted(group(collect(folder)), key=lambda item: item.condition.strength)
            if item.condition.axis == axis
        ]
        curve = statistics.area_under_curve([0.0, 0.5, 1.0], [np.mean(row) for row in rows])
        assert area == f"{100 * curve / np.mean(rows[0]):.0f} %"
        assert (plain, strength) == (f"{sum(rows[0])}/20", "1")
        assert shifted == f"{sum(rows[-1])}/20"
        assert kept.startswith(f"{100 * sum(rows[-1]) / sum(rows[0]):.0f} %")
    widths = [float(word) for word in re.findall(r'<rect[^>]* width="([\d.]+)"', chart.drawing)]
    assert widths == sorted(widths) and len(widths) == 3


def test_curves_that_were_measured_twice_are_drawn_twice(tmp_path):
    generator = np.random.default_rng(5)
    for out, axis, strength in itertools.product("ab", ("light", "blur"), (0.0, 0.5, 1.0)):
        run = run_of("grasp", "imagenet", ("back",), 0, shift=Shift(axis, strength))
        place = tmp_path / out / axis / f"{strength:g}"
        evaluation(place, run, 0.9 - 0.5 * strength, generator, {"checkpoint": CHECKPOINT})
    groups = group(collect(tmp_path))
    assert [len(chart.rows) for chart in robustness_curves(groups)] == [2, 2]
    assert [chart.title for chart in retentions(groups)] == [
        "grasp: imagenet · a on back",
        "grasp: imagenet · b on back",
    ]


def test_a_curve_stays_whole_if_only_some_of_it_was_measured_twice(tmp_path):
    generator = np.random.default_rng(5)
    measured = [("a", "light", 0.0), ("a", "light", 0.5)]
    measured += itertools.product("b", ("light", "blur"), (0.0, 0.5, 1.0))
    for out, axis, strength in measured:
        run = run_of("grasp", "imagenet", ("back",), 0, shift=Shift(axis, strength))
        place = tmp_path / out / axis / f"{strength:g}"
        evaluation(place, run, 0.9 - 0.5 * strength, generator, {"checkpoint": CHECKPOINT})
    groups = group(collect(tmp_path))
    charts = {chart.title: chart.rows for chart in robustness_curves(groups)}
    rows = {row[0]: row for row in charts["grasp: light"]}
    assert set(rows) == {"imagenet · a on back", "imagenet · b on back"}
    assert rows["imagenet · a on back"][3] == "–"  # it has no strength 1
    assert "–" not in rows["imagenet · b on back"]
    (chart,) = retentions(groups)
    assert (chart.title, len(chart.rows)) == ("grasp: imagenet · b on back", 2)


def test_what_never_succeeds_plainly_has_no_worst_axis(tmp_path):
    generator = np.random.default_rng(5)
    for axis, strength in itertools.product(("light", "blur"), (0.0, 1.0)):
        run = run_of("grasp", "imagenet", ("back",), 0, shift=Shift(axis, strength))
        evaluation(tmp_path / axis / f"{strength:g}", run, -5.0, generator)
    (chart,) = retentions(group(collect(tmp_path)))
    assert [row[1] for row in chart.rows] == ["–", "–"]
    assert "no plain success" in chart.more and "Worst" not in chart.more


def test_held_out_looks_stand_beside_those_for_training(folder):
    ((task, label, held_in, held_out, kept),) = looks(group(collect(folder)))
    assert (task, label.split(" ")[0]) == ("insert", "imagenet")
    first, second = (int(words.split("/")[0]) for words in (held_in, held_out))
    assert first > second
    assert kept.startswith(f"{100 * second / first:.0f} %")


def test_each_family_of_held_out_looks_has_its_own_row(tmp_path):
    generator = np.random.default_rng(5)
    shown = {
        look: TaskConfig("insert", randomisation=RandomisationConfig(appearance=look))
        for look in (names.TRAIN, *names.HELDOUT_APPEARANCES)
    }
    trained = replace(run_of("insert", "imagenet", ("back",), 0), env=shown[names.TRAIN])
    for place, (look, env) in enumerate(shown.items()):
        run = evaluated_in(trained, env)
        rate = -0.5 if place == 1 else 1.5  # the first held-out family fails everywhere
        evaluation(tmp_path / look, run, rate, generator, {"checkpoint": CHECKPOINT})
    rows = looks(group(collect(tmp_path)))
    held_out = {row[1].split(" and ")[-1]: row[3].split("/")[0] for row in rows}
    first, *others = names.HELDOUT_APPEARANCES
    assert held_out == {first: "0", **dict.fromkeys(others, "20")}


def test_policies_that_differ_in_their_demonstrations_are_told_apart(tmp_path):
    generator = np.random.default_rng(5)
    about = {"checkpoint": CHECKPOINT}
    for count, at_full in ((50, -0.5), (350, 1.5)):
        for axis, strength in itertools.product(("light", "blur"), (0.0, 1.0)):
            shift = Shift(axis, strength)
            run = run_of("grasp", "imagenet", ("back",), 0, demonstrations=count, shift=shift)
            rate = at_full if strength else 1.5
            evaluation(tmp_path / f"{count}-{axis}-{strength}", run, rate, generator, about)
        shown = {
            look: TaskConfig("grasp", randomisation=RandomisationConfig(appearance=look))
            for look in (names.TRAIN, names.HELDOUT)
        }
        trained = run_of("grasp", "imagenet", ("back",), 0, demonstrations=count)
        trained = replace(trained, env=shown[names.TRAIN])
        for look, env in shown.items():
            run = evaluated_in(trained, env)
            evaluation(tmp_path / f"{count}-{look}", run, 0.5, generator, about)
    groups = group(collect(tmp_path))
    policies = [f"imagenet on back, {count} demonstrations" for count in (50, 350)]
    assert [chart.title for chart in retentions(groups)] == [f"grasp: {name}" for name in policies]
    for chart in robustness_curves(groups):
        areas = {row[0]: row[-1].split(" ")[0] for row in chart.rows}
        assert areas == dict(zip(policies, ("0.50", "1.00"), strict=True))
    assert [row[1] for row in looks(groups)] == policies


def test_the_page_shows_both_and_stands_alone(folder, monkeypatch):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    report.write_report(folder)
    text = (folder / "report.html").read_text()
    assert_stands_alone(text)
    section = text.split('id="retention"')[1].split("<h2")[0]
    assert section.count('<svg class="curve"') == 1
    assert "held-out looks" in section and "Worst single axis: blur" in section
