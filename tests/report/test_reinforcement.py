"""Algorithms in the report: rliable's aggregates, a table next to the paper's, learning curves."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean
from sweep_results import CHECKPOINT, episode, evaluation
from test_report import assert_stands_alone, painted_stage

from surgicai_vision import report
from surgicai_vision.core import files, names
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation import statistics
from surgicai_vision.evaluation.storage import write_evaluation
from surgicai_vision.report.aggregates import (
    bootstrap,
    interquartile_mean,
    probability_of_improvement,
)
from surgicai_vision.report.charts import COLOURS, Point, Series
from surgicai_vision.report.curves import MOST
from surgicai_vision.report.groups import group
from surgicai_vision.report.reader import collect
from surgicai_vision.report.reinforcement import (
    CurvePoint,
    _chart,
    _points,
    first_at,
    learned,
    markdown,
    read_curve,
    table,
)
from surgicai_vision.report.sections import ceilings
from surgicai_vision.training.run_config import RunConfig, Starts, evaluated_in

RATES = {"td3": 0.1, "td3-her-bc": 0.9, "bc": 0.6}


def run_of(algo, task, seed):
    online = algo != "bc"
    return RunConfig(
        TaskConfig(task),
        policy="actor",
        recipe="rl",
        demonstrations=None if algo == "td3" else 100,
        updates=None if online else 5000,
        seed=seed,
        algo=algo,
        env_steps=2000 if online else 0,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three algorithms on two tasks with three seeds; one has no result on the second task."""
    out = tmp_path_factory.mktemp("learned")
    generator = np.random.default_rng(3)
    for algo, task, seed in itertools.product(RATES, ("grasp", "insert"), (0, 1, 2)):
        if (algo, task) == ("bc", "insert"):
            continue
        place = out / "runs" / f"{algo}-{task}-{seed}"
        about = {"checkpoint": CHECKPOINT}
        evaluation(place / "evaluation", run_of(algo, task, seed), RATES[algo], generator, about)
        if algo != "bc":
            points = [
                {"env_steps": 1000 * n, "updates": 500 * n, "minutes": 0.5 * n + 0.01 * seed,
                 "successes": min(10 * n, int(20 * RATES[algo]) + 2), "episodes": 20,
                 "distance_mm": 1.0} for n in (1, 2)
            ]  # fmt: skip
            (place / "policy").mkdir()
            files.write_json(place / "policy" / "curve.json", points)
    return out


# -- aggregates ------------------------------------------------------------------------------------


def test_the_interquartile_mean_is_rliables():
    generator = np.random.default_rng(0)
    for tasks, seeds in ((5, 3), (1, 4), (2, 7), (1, 1)):
        scores = generator.uniform(size=(tasks, seeds))
        assert interquartile_mean(scores) == pytest.approx(trim_mean(scores, 0.25, axis=None))


def test_the_probability_of_improvement_is_mann_whitneys_u_over_the_pairs():
    generator = np.random.default_rng(1)
    first = generator.integers(0, 4, (3, 4)) / 4
    second = generator.integers(0, 4, (3, 5)) / 4
    expected = [
        mannwhitneyu(one, other).statistic / 20 for one, other in zip(first, second, strict=True)
    ]
    found = probability_of_improvement(first, second)
    assert found == pytest.approx(np.mean(expected))
    assert probability_of_improvement(second, first) == pytest.approx(1 - found)
    with pytest.raises(InputError):
        probability_of_improvement(first, second[:2])


def test_the_bootstrap_covers_and_knows_when_there_is_no_spread():
    generator = np.random.default_rng(2)
    assert bootstrap(interquartile_mean, [[[0.5, 0.5], [0.5]]], generator) == (0.5, 0.5)
    scores = generator.uniform(size=(5, 6))
    low, high = bootstrap(interquartile_mean, [scores], generator)
    assert 0 <= low < interquartile_mean(scores) < high <= 1 and high - low < 0.6


# -- the page --------------------------------------------------------------------------------------


def test_the_table_counts_all_seeds_beside_the_papers_number(folder):
    groups = group(collect(folder))
    rows = table(groups)
    assert [row.algo for row in rows] == ["td3", "td3-her-bc", "bc"]
    found = learned(groups)
    assert found.tasks == ("grasp", "insert")
    cells = {row[0]: row[1:] for row in found.rows}
    won = {
        (item.condition.trained_by, item.condition.task): (item.successes, item.interval)
        for item in groups
    }
    count, bounds = won["td3-her-bc", "grasp"]
    low, high = statistics.clopper_pearson(count, 60)
    assert bounds == (low, high)
    assert cells["td3-her-bc, 100 demonstrations"][0] == (
        f"{count}/60, 3 seeds ({100 * low:.0f}–{100 * high:.0f} %); paper 96 %"
    )
    assert cells["bc, 100 demonstrations"][1] == "–; paper 97 %"
    assert cells["td3"][2].endswith("6 runs, 2 tasks")
    assert found.best == "td3-her-bc, 100 demonstrations"
    better = {row[0]: row[1:] for row in found.better}
    assert better["td3"][0].startswith("1.00") and better["td3"][1] == "grasp, insert"
    assert better["bc, 100 demonstrations"][1] == "grasp"


def test_learning_curves_are_read_beside_the_policy(folder):
    groups = group(collect(folder))
    (result, *_) = next(i for i in groups if i.condition.trained_by == "td3-her-bc").results
    curve = read_curve(result)
    assert [(point.env_steps, point.successes) for point in curve] == [(1000, 10), (2000, 20)]
    assert first_at(0.95, curve) == curve[1] and first_at(0.4, curve) == curve[0]
    assert first_at(0.95, curve[:1]) is None
    found = learned(groups)
    assert [chart.title for chart in found.curves] == [
        f"{task}: {axis}"
        for task in ("grasp", "insert")
        for axis in ("control steps, thousands", "CPU minutes of learning")
    ]
    rows = {row[0]: row for row in found.curves[0].rows}
    assert rows["td3-her-bc, 100 demonstrations"][2] == "2, 2, 2", "in thousands"
    minutes = {row[0]: row[2] for row in found.curves[1].rows}
    assert minutes["td3-her-bc, 100 demonstrations"] == "1, 1.01, 1.02"
    assert rows["td3"][2] == "never, never, never"


def test_a_seed_that_has_ended_counts_with_its_last_evaluation():
    short = [CurvePoint(1000, 500, 1.0, 10, 20)]
    long = [CurvePoint(1000, 500, 2.0, 0, 20), CurvePoint(2000, 1000, 4.0, 5, 20)]
    points = _points([short, long, []], lambda point: point.minutes)
    assert [(point.x, point.rate) for point in points] == [(1.5, 10 / 40), (4.0, 15 / 40)]
    assert points[-1].text.startswith("15/40") and points[-1].text.endswith("at 4")


def test_a_slow_seed_that_ends_first_does_not_turn_the_line_back():
    slow = [CurvePoint(1000 * at, 0, 2.0 * at, 10, 20) for at in range(1, 4)]
    fast = [CurvePoint(1000 * at, 0, 1.0 * at, 10, 20) for at in range(1, 7)]
    places = [point.x for point in _points([slow, fast], lambda point: point.minutes)]
    assert places == [1.5, 3.0, 4.5, 4.5, 5.0, 6.0]


def test_an_algorithm_has_one_colour_and_what_all_share_is_said_once(folder):
    groups = [item for item in group(collect(folder)) if item.condition.trained_by != "bc"]
    lost = ("td3", "grasp")  # the first algorithm has no result on the first task
    some = [i for i in groups if (i.condition.trained_by, i.condition.task) != lost]
    found = learned(some)
    (one, *_), (*_, other) = (
        [str(c.drawing) for c in found.curves if c.title.startswith(task)]
        for task in ("grasp", "insert")
    )
    assert COLOURS[1] in one and COLOURS[0] not in one
    assert COLOURS[1] in other and COLOURS[0] in other
    cloned = [item for item in groups if item.condition.trained_by == "td3-her-bc"]
    assert learned(cloned).rows[0][0] == "td3-her-bc"
    assert learned(cloned).shared == ("100 demonstrations",)
    assert learned(groups).shared == ()


def test_other_worlds_starts_and_budgets_are_rows_of_their_own(tmp_path):
    generator = np.random.default_rng(0)
    plain = run_of("td3-her-bc", "grasp", 0)
    soft = replace(plain, env=TaskConfig("grasp", SceneConfig(tissue="soft")))
    runs = {
        "": plain,
        "in tissue soft": soft,
        "demonstrated in tissue soft": evaluated_in(soft, TaskConfig("grasp")),
        "moved": replace(plain, condition="moved"),
    }
    for name, run in runs.items():
        evaluation(tmp_path / "worlds" / (name or "plain"), run, 0.5, generator)
    rows = {row[0]: row[1] for row in learned(group(collect(tmp_path / "worlds"))).rows}
    assert rows.keys() == {", ".join(filter(None, ("td3-her-bc", name))) for name in runs}
    assert {name for name, cell in rows.items() if "paper" in cell} == {
        "td3-her-bc",
        "td3-her-bc, moved",
    }
    for steps in (2000, 9000):
        run = replace(plain, env_steps=steps, seed=steps)
        evaluation(tmp_path / "budgets" / str(steps), run, 0.5, generator)
    rows = learned(group(collect(tmp_path / "budgets"))).rows
    assert {row[0] for row in rows} == {
        "td3-her-bc, 2,000 control steps",
        "td3-her-bc, 9,000 control steps",
    }


def test_multiplied_demonstrations_are_a_row_of_their_own_that_markdown_can_show(tmp_path):
    generator = np.random.default_rng(0)
    plain = run_of("td3-her-bc", "grasp", 0)
    for name, run in {
        "plain": plain,
        "multiplied": replace(plain, multiplied_from=10),
        "named": replace(plain, condition="a|b"),
    }.items():
        evaluation(tmp_path / name, run, 0.5, generator)
    found = learned(group(collect(tmp_path)))
    assert {row[0] for row in found.rows} == {
        "td3-her-bc",
        "td3-her-bc, multiplied from 10",
        "td3-her-bc, a|b",
    }
    assert "| td3-her-bc, a\\|b |" in markdown(found)


def test_validation_starts_are_not_called_held_out(tmp_path):
    cloned = RunConfig(TaskConfig("grasp"), privileged=True, demonstrations=100)
    for name, run in (("actor", run_of("td3-her-bc", "grasp", 0)), ("cloned", cloned)):
        made = [
            episode("grasp", name, names.VALIDATION_SEED + index, True, np.random.default_rng(0))
            for index in range(4)
        ]
        starts = Starts(names.VALIDATION_SEED, 4)
        write_evaluation(tmp_path / name, made, replace(run, starts=starts), {})
    groups = group(collect(tmp_path))
    found = learned(groups)
    assert "paper" not in found.rows[0][1]
    assert markdown(found).startswith("Success from validation starts")
    assert "ours" not in ceilings(groups)


def test_a_curve_that_only_a_later_algorithm_has_is_in_the_table():
    drawn = [Series(f"line {index}", ()) for index in range(MOST)]
    points = tuple(Point(x, 0.5, 0.4, 0.6, "1/2") for x in (1.0, 2.0))
    curve = [CurvePoint(1000, 500, 1.0, 1, 2)]
    chart = _chart("t", [*drawn, Series("last", points)], "x", lambda point: 1.0, {"last": [curve]})
    assert (chart.drawing, chart.more) == ("", "1 more in the table.")
    assert [row[0] for row in chart.rows] == ["last"]


def test_the_page_and_its_tables_have_them(folder, monkeypatch):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    page = report.write_report(folder, strips=0)
    assert_stands_alone(page.read_text())
    text = (page.parent / "tables" / "algorithms.md").read_text()
    assert "td3-her-bc, 100 demonstrations" in text and "probability of improvement" in text
    assert 'id="learned"' in page.read_text()


def test_without_actors_there_is_no_such_section(tmp_path):
    run = RunConfig(TaskConfig("grasp"), "imagenet", ("back",), demonstrations=50)
    evaluation(tmp_path / "one", run, 0.5, np.random.default_rng(0), {"checkpoint": CHECKPOINT})
    assert learned(group(collect(tmp_path))) is None
