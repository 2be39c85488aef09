"""The report of a sweep.

Nothing is silently absent, numbers agree with the rows, and the page is self-contained.
"""

import csv
import itertools
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from checkpoints import checkpoint
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from sweep_results import (
    COMMAND,
    STAGE_ERRORS,
    TASKS,
    add_curves,
    episode,
    evaluation,
    run_of,
    store_run,
    write_sweep,
)
from test_report import assert_stands_alone, painted_stage

from surgicai_vision import report
from surgicai_vision.commands.main import main
from surgicai_vision.commands.report import Options
from surgicai_vision.core import names
from surgicai_vision.core.config import (
    RandomisationConfig,
    SceneConfig,
    TaskConfig,
    to_mapping,
)
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation import statistics
from surgicai_vision.evaluation.robustness.axes import AXES, shifted_config
from surgicai_vision.evaluation.storage import FORMAT, write_evaluation
from surgicai_vision.experiments.sweep.grid import Grid
from surgicai_vision.experiments.sweep.plan import RunState
from surgicai_vision.report import (
    charts,
    curves,
    filmstrips,
    formats,
    page,
    paper,
    paper_comparison,
    probes,
    tables,
)
from surgicai_vision.report.experiment_key import Condition, condition_of, order
from surgicai_vision.report.failures import failure_sheet
from surgicai_vision.report.groups import best_trained, group, of_task
from surgicai_vision.report.pairs import compare, factor
from surgicai_vision.report.reader import collect
from surgicai_vision.report.sections import heat_maps
from surgicai_vision.training.run_config import RunConfig, Shift, Starts, evaluated_in

LIMIT = 8_000_000
EXPERT = RunConfig(TaskConfig("grasp"), policy="expert")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A sweep's folder with its report."""
    folder = add_curves(write_sweep(tmp_path_factory.mktemp("sweep") / "table"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact_sheet, "state_renderer", painted_stage)
        report.write_report(folder)
    return folder


@pytest.fixture(scope="module")
def text(written):
    return (written / "report.html").read_text()


@pytest.fixture(scope="module")
def groups(written):
    return group(collect(written))


def find(groups, **wanted):
    """The only group with these values in its condition."""
    found = [
        item
        for item in groups
        if all(getattr(item.condition, name) == v for name, v in wanted.items())
    ]
    assert len(found) == 1, (wanted, len(found))
    return found[0]


def rows_of(text, table):
    """The rows of one table of the page, each as the texts of its cells."""
    body = text.split(f'id="{table}"')[1].split("<tbody>")[1].split("</tbody>")[0]
    return [
        [re.sub(r"<[^>]+>", " ", c).strip() for c in row.split("</td>")[:-1]]
        for row in body.split("</tr>")[:-1]
    ]


def test_the_papers_numbers_are_the_printed_ones(shared):
    facts = (shared / "facts.md").read_text()
    block = facts.split("Table 2 of the paper")[1].split("State-based")[0]
    lines = re.findall(r"(?m)^\| (\w+) \| ([\d./ |]+)\|$", block)
    assert [task for task, _ in lines] == ["grasp", "place", "handoff", "pullout"]
    for task, numbers in lines:
        for encoder, pair in zip(paper.ENCODERS, numbers.split("|"), strict=False):
            front, back = (float(number) for number in pair.strip().split("/"))
            assert (paper.rate(task, encoder, "front"), paper.rate(task, encoder, "back")) == (
                front,
                back,
            )
    assert paper.rate("insert", "clip", "back") is None
    for task in (
        "grasp",
        "place",
        "handoff",
        "pullout",
    ):  # hence the paper's intervals are those of 60 episodes
        rates = [
            paper.rate(task, encoder, view) for encoder in paper.ENCODERS for view in paper.VIEWS
        ]
        assert all(abs(round(60 * rate) / 60 - rate) < 0.0051 for rate in rates)


def test_the_paper_stands_beside_ours_cell_by_cell(text, groups):
    rows = {(row[0], row[1]): row[2:] for row in rows_of(text, "paper")}
    assert {task for task, _ in rows} == {*TASKS, "place"}
    ours = find(groups, task="grasp", encoder="imagenet", views=("back",))
    assert rows["grasp", "imagenet"][0] == "8 %"
    assert rows["grasp", "imagenet"][3] == "10 %"
    assert f"{ours.successes}/{ours.episodes}" in rows["grasp", "imagenet"][4]
    assert rows["insert", "imagenet"][0] == "not reported"
    assert rows["insert", "imagenet-lite"][0] == "not in the paper"
    assert rows["grasp", "r3m"][1] == "not run"
    assert rows["grasp", "clip"][1] == "not in this sweep"
    assert (
        "Behaviour cloning from the state, its Table 1: grasp 96 %; place 100 %; insert 97 %"
        in text
    )
    assert paper_comparison.paper_rate(ours.condition) == 0.10


def test_every_cell_is_there_with_its_count_and_interval(text, groups, written):
    shown = rows_of(text, "success")
    assert len(shown) == len(groups)
    for item, row in zip(groups, shown, strict=True):
        if item.episodes:
            low, high = statistics.clopper_pearson(item.successes, item.episodes)
            assert row[3] == f"{item.successes}/{item.episodes}"
            assert f"({100 * low:.0f}–{100 * high:.0f} %)" in " ".join(row[4].split())
    records = pq.read_table(written / "tables/cells.parquet").to_pylist()
    done = [record for record in records if record["state"] == "done"]
    assert len(done) == len(list(written.rglob("evaluation.json")))
    for record in done:
        assert (record["low"], record["high"]) == statistics.clopper_pearson(
            record["successes"], record["episodes"]
        )
        assert record["command"] == COMMAND
        kinds = sum(
            record[kind] for kind in ("missed", "dropped", "wrong_hole", "time", "physics", "error")
        )
        assert kinds == record["episodes"] - record["successes"]


def test_across_training_seeds_are_mean_deviation_and_bootstrap(groups):
    item = find(groups, task="insert", encoder="imagenet-lite", views=("front",))
    rates = [result.summary["success_rate"] for result in item.results]
    assert len(rates) == 2
    assert item.across.mean == pytest.approx(np.mean(rates))
    assert item.across.std == pytest.approx(np.std(rates, ddof=1))
    outcomes = [[float(row["success"]) for row in result.rows] for result in item.results]
    assert item.across.interval == statistics.hierarchical_bootstrap(
        outcomes, np.random.default_rng(0)
    )
    assert find(groups, task="grasp", encoder="proprioception").across is None


def test_what_failed_or_was_not_run_is_told_with_its_reason(text, written, groups):
    missing = text.split('id="missing"')[1].split('id="origin"')[0]
    assert missing.count('class="state not run"') == 9, "one row a condition"
    assert missing.count('training seeds">0, 1<') == 9
    assert missing.count('class="state failed"') == 1
    assert missing.count("R3M&#39;s weights are not here; see its card.") == 9
    assert "RuntimeError: the disk is full" in missing
    assert "failed: replay-grasp: the mean demonstration is empty" in missing
    assert "1 training seed failed" in text
    states = pq.read_table(written / "tables/cells.parquet")["state"].to_pylist()
    assert (states.count("not run"), states.count("failed")) == (18, 1)
    assert len(find(groups, task="handoff", encoder="imagenet", views=("back",)).results) == 1


def test_a_plans_cells_that_nobody_came_to_are_pending(tmp_path):
    write_sweep(tmp_path / "s", tasks=("grasp",), seeds=(0,), views=(("back",),))
    plan = [
        RunState(run_of("grasp", "imagenet", ("back",), 0), "a", "to do", "made by other code"),
        RunState(run_of("grasp", "imagenet", ("front",), 0), "b", "to do"),
        RunState(run_of("grasp", "clip", ("front",), 3), "c", "not run", "no weights"),
    ]
    missing = collect(tmp_path / "s", plan).missing
    assert [(item.condition.encoder, item.seed, item.state) for item in missing] == [
        ("clip", 3, "not run"),
        ("imagenet", 0, "pending"),
        ("r3m", 0, "not run"),
    ]
    assert missing[0].reason == "no weights"


def test_what_could_not_be_run_where_the_sweep_ran_stays_not_run_here(tmp_path):
    write_sweep(tmp_path, tasks=("grasp",), seeds=(0,), views=(("back",),))
    plan = [RunState(run_of("grasp", "r3m", ("back",), 0), "a", "to do")]
    (missing,) = collect(tmp_path, plan).missing
    assert (missing.state, missing.reason) == (
        "not run",
        "R3M's weights are not here; see its card.",
    )


def test_a_cell_that_the_run_skipped_is_told_whatever_its_name(tmp_path):
    write_sweep(tmp_path, tasks=("grasp",), seeds=(0,), views=(("back",),))
    run = json.loads((tmp_path / "run.json").read_text())
    skipped = run_of("grasp", "clip", ("front",), 0, changes=("epochs=2",))
    run["skipped"] = [{"key": "a", "run": to_mapping(skipped), "reason": "its licence"}]
    (tmp_path / "run.json").write_text(json.dumps(run))
    missing = collect(tmp_path, [RunState(skipped, "a", "to do")]).missing
    assert [(item.condition.label, item.state, item.reason) for item in missing] == [
        ("clip · paper · epochs=2 on front", "not run", "its licence")
    ]


def test_cells_keep_their_columns_where_the_first_has_no_result(tmp_path):
    write_sweep(
        tmp_path, tasks=("grasp",), seeds=(0,), views=(("back",),), encoders={"random": 0.5}
    )
    missing = json.loads((tmp_path / "run.json").read_text())
    lacking = to_mapping(run_of("grasp", "clip", ("back",), 0))
    missing["skipped"] = [{"key": "a", "run": lacking, "reason": "its licence"}]
    (tmp_path / "run.json").write_text(json.dumps(missing))
    found = group(collect(tmp_path))
    assert not found[0].episodes
    table = pq.read_table(tables.write_tables(tmp_path, found, [], [], "title") / "cells.parquet")
    assert {"low", "high", "command", "missed"} <= set(table.column_names)


def test_the_command_reports_a_sweep_that_it_cannot_plan(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    write_sweep(tmp_path, tasks=("grasp",), seeds=(0,), views=(("back",),))
    grid = Grid(("grasp",), ("random",), (("back",),), recipe=("gone.yaml",))
    stored = {"format": FORMAT, "grid": to_mapping(grid)}
    (tmp_path / "sweep.json").write_text(json.dumps(stored))
    assert main(["report", str(tmp_path), "--strips", "2", "--json"]) == 0
    said = capsys.readouterr()
    told = json.loads(said.out.splitlines()[-1])
    assert (told["evaluations"], told["missing"]) == (5, 1)
    assert "cannot be planned" in said.err
    assert Options(tmp_path).strips == filmstrips.MOST_STRIPS


def test_a_folder_where_every_cell_failed_has_a_report(tmp_path, monkeypatch):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    folder = tmp_path / "runs" / "a"
    folder.mkdir(parents=True)
    failed = to_mapping(run_of("grasp", "random", ("front",), 0))
    (folder / "failed.json").write_text(
        json.dumps({"format": FORMAT, "run": failed, "error": "no disk"})
    )
    text = report.write_report(tmp_path).read_text()
    assert "No cell has a result yet" in text
    assert "no disk" in text
    assert_stands_alone(text)


def test_a_cell_and_its_record_have_the_same_condition(tmp_path):
    """A failed seed and a finished one must fall into one group, whatever the cell's variant."""
    described = run_of(
        "grasp", "random", ("front",), 1, policy="act", changes=("clock=true",), demonstrations=30
    )
    store_run(tmp_path, "done", replace(described, seed=0), 0.5, np.random.default_rng(0))
    (tmp_path / "runs/broken").mkdir()
    (tmp_path / "runs/broken/failed.json").write_text(
        json.dumps({"format": FORMAT, "run": to_mapping(described), "error": "no disk"})
    )
    (item,) = group(collect(tmp_path))
    assert (len(item.results), len(item.missing)) == (1, 1)
    assert item.condition.variant == "act · clock=true"
    assert item.condition.demonstrations == 30


def test_a_curve_runs_over_the_minutes_that_one_training_was_given(tmp_path):
    generator = np.random.default_rng(0)
    for index, (minutes, rate) in enumerate(((3, 0.2), (10, 0.5), (30, 0.9))):
        given = ("clock=true", f"minutes={minutes}")
        run = run_of("handoff", "random", ("front",), 0, policy="act", changes=given)
        store_run(tmp_path, f"act-{index}", run, rate, generator)
    store_run(tmp_path, "bc", run_of("handoff", "random", ("front",), 0), 0.9, generator)
    groups = group(collect(tmp_path))
    (chart,) = curves.budget_curves(groups)
    assert chart.head == ("policy", "3", "10", "30")
    (row,) = chart.rows
    assert "clock=true" in row[0] and "minutes" not in row[0]
    by_budget = {item.condition.minutes: f"{item.successes}/20" for item in groups}
    assert [cell.split(",")[0] for cell in row[1:]] == [by_budget[m] for m in (3, 10, 30)]
    assert curves.budget_curves([item for item in groups if item.condition.minutes != 3]) != []
    assert curves.budget_curves([item for item in groups if item.condition.minutes == 30]) == []


def test_a_reference_that_several_sweeps_evaluated_stands_once(tmp_path):
    for name, seed, episodes in (("right", 0, 20), ("left", 0, 12), ("other", 1, 20)):
        rate = 0.6  # the same generator draws the same first episodes
        evaluation(tmp_path / name, EXPERT, rate, np.random.default_rng(seed), {}, episodes)
    told = {(r.folder.name, r.condition.place) for r in collect(tmp_path).results}
    assert told == {
        ("right", "right"),
        ("other", "other"),
    }, "what another saw goes in, what differs is told apart"
    shutil.rmtree(tmp_path / "other")
    assert [(r.folder.name, r.condition.place) for r in collect(tmp_path).results] == [
        ("right", "")
    ]


def test_what_the_encoder_gave_is_told_and_stands_not_beside_the_papers_number(tmp_path):
    run = run_of("grasp", "imagenet", ("back",), 0, pool="spatial")
    evaluation(tmp_path / "spatial", run, 0.5, np.random.default_rng(0))
    (result,) = collect(tmp_path).results
    assert result.condition.pool == "spatial" and "spatial" in result.condition.label
    assert paper_comparison.paper_rate(result.condition) is None


def test_training_seeds_under_other_rules_are_another_condition(tmp_path):
    plain = run_of("grasp", "imagenet", ("back",), 0)
    eased = TaskConfig("grasp", tolerance="released", max_steps=400)
    other = replace(plain, env=eased, seed=1)
    for name, run in (("plain", plain), ("other", other)):
        evaluation(tmp_path / name, run, 0.5, np.random.default_rng(0))
    first, second = group(collect(tmp_path))
    assert (first.label, first.episodes) == ("imagenet on back", 20)
    rules = "tolerance released, max_steps 400"
    assert (second.label, second.episodes) == (f"imagenet · with {rules} on back", 20)
    assert paper_comparison.paper_rate(first.condition) == 0.10
    assert paper_comparison.paper_rate(second.condition) is None
    assert factor(first.condition, second.condition) == "rules"
    limits = TaskConfig("suture", max_steps=20, advance="told")
    assert not condition_of(RunConfig(limits, termination="learned", parts="a")).rules, "its own"


def test_training_seeds_of_other_demonstrations_or_budgets_are_another_condition(tmp_path):
    one = run_of("grasp", "imagenet", ("back",), 0, demonstrator="expert", noise=0.5, updates=2000)
    runs = {
        "noise 0.5, 2,000 updates": one,
        "noise 0, 2,000 updates": replace(one, seed=1, noise=0.0),
        "noise 0.5, 500 updates": replace(one, seed=2, updates=500),
    }
    for name, run in runs.items():
        evaluation(tmp_path / name, run, 0.5, np.random.default_rng(0))
    groups = group(collect(tmp_path))
    assert {item.label for item in groups} == {f"imagenet on back, {name}" for name in runs}
    assert all(item.episodes == 20 for item in groups)
    assert sorted(pair.factor for pair in compare(groups)) == []  # no training seed in common
    named = {item.details: item.condition for item in groups}
    first, calm, short = (named[name] for name in runs)
    assert factor(first, calm) == "noise of the demonstrations"
    assert factor(first, short) == "budget"
    assert factor(calm, short) == ""
    measured = RunConfig(TaskConfig("suture"), algo="ppo", updates=100, env_steps=7123)
    assert condition_of(measured).budget == "100 updates", "control steps differ between seeds"


def test_a_command_repeats_only_what_it_says(tmp_path):
    generator = np.random.default_rng(0)
    folder = checkpoint(tmp_path / "policy", "grasp")
    plain = RunConfig(TaskConfig("grasp"), demonstrations=1)
    moved = RandomisationConfig(phantom_shift=3.0)
    runs = {
        "plain": plain,
        "moved": evaluated_in(plain, TaskConfig("grasp", randomisation=moved)),
        "short": replace(plain, env=TaskConfig("grasp", max_steps=50)),
        "acting": replace(plain, acted_by=("execute=5",)),
        "aimed": replace(plain, detector="12345678abcd"),
        "expert": EXPERT,
        "soft": replace(EXPERT, env=TaskConfig("grasp", SceneConfig(tissue="soft"))),
    }
    for name, run in runs.items():
        about = {"folder": folder} if run.is_trained else {}
        about |= {"detector": "my detector"} if run.detector else {}
        evaluation(tmp_path / "out" / name, run, 0.5, generator, about)
    starts = "--task grasp --episodes 20 --seed 900000 --json"
    assert {
        result.folder.name: tables.evaluate_command(result)
        for result in collect(tmp_path / "out").results
    } == {
        **dict.fromkeys(runs),
        "plain": f"surgicai-vision evaluate {folder} {starts}",
        "aimed": f"surgicai-vision evaluate {folder} --detector 'my detector' {starts}",
        "expert": f"surgicai-vision evaluate expert {starts}",
    }


def test_the_table_of_cells_counts_rows(tmp_path):
    evaluation(tmp_path, EXPERT, 1.5, np.random.default_rng(0))
    (item,) = group(collect(tmp_path))
    item.results[0].summary["successes"] = 3
    (cell,) = tables.cell_records([item])
    assert (cell["successes"], cell["rate"]) == (20, 1.0)


def test_results_of_another_version_are_refused_in_one_line(tmp_path, root, capsys):
    for folder in (root / "docs/results/scene-0.1", root / "docs/results/scene-0.1/chain"):
        assert main(["report", str(folder), "--out", str(tmp_path / "report.html")]) == 2
        (error,) = capsys.readouterr().err.strip().splitlines()
        assert "of another version" in error


def test_an_evaluation_without_films_has_a_report(tmp_path, monkeypatch):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    evaluation(tmp_path, EXPERT, 1.5, np.random.default_rng(0))
    (tmp_path / "films.safetensors").unlink()
    assert "20/20" in report.write_report(tmp_path).read_text()


def test_pairs_differ_in_one_thing_and_are_corrected_within_their_task(groups):
    pairs = compare(groups)
    assert {pair.factor for pair in pairs} == {"encoder", "views", "images", "demonstrations"}
    grasp = [pair for pair in pairs if pair.first.condition.task == "grasp"]
    assert sorted(pair.adjusted for pair in grasp) == pytest.approx(
        sorted(statistics.holm([p.p for p in grasp]))
    )
    pair = next(pair for pair in grasp if pair.factor == "encoder")
    assert pair.episodes == 40
    wins = [
        {(r.seed, row["seed"]): row["success"] for r in side.results for row in r.rows}
        for side in (pair.first, pair.second)
    ]
    assert pair.first_only == sum(wins[0][key] and not wins[1][key] for key in wins[0])
    assert pair.p == statistics.mcnemar(
        [wins[0][key] for key in wins[0]], [wins[1][key] for key in wins[0]]
    )


def test_conditions_that_differ_in_two_things_are_no_pair():
    one = Condition("grasp", "imagenet", ("front",))
    assert factor(one, Condition("grasp", "random", ("back",))) == ""
    assert factor(one, Condition("grasp", "state")) == ""
    assert factor(one, Condition("grasp", "proprioception")) == "images"
    assert factor(one, replace(one, trained_by="act")) == "policy"
    early = {"encoder": "imagenet-lite-early", "views": ("front_psm2",), "pool": "spatial"}
    best = Condition("grasp", **early, recipe="best", demonstrations=350)
    assert factor(one, best) == "recipe", "a recipe is compared as a whole"
    assert factor(replace(best, changes=("clock=false",)), best) == "change"
    assert factor(Condition("grasp", "proprioception"), best) == ""
    blind = Condition("grasp", "proprioception", recipe="best", demonstrations=350)
    assert factor(blind, best) == "images", "without an encoder nothing is taken from it"


def test_policies_of_different_kinds_are_compared_with_the_recipe_of_each():
    images = {"encoder": "imagenet-lite-early", "views": ("front_psm2",), "pool": "spatial"}
    best = Condition("grasp", **images, recipe="best", demonstrations=350)
    act = replace(best, trained_by="act", recipe="act", changes=("minutes=30", "clock=true"))
    vqbet = replace(best, trained_by="vqbet", recipe="vqbet", changes=("minutes=30",))
    assert factor(best, act) == "policy"
    assert factor(act, vqbet) == "policy"
    assert factor(act, replace(vqbet, changes=("minutes=10",))) == "", "less time to train"
    assert factor(act, replace(vqbet, views=("back_psm2",))) == "", "other images"
    assert factor(act, replace(vqbet, demonstrations=100)) == "", "other demonstrations"
    assert factor(act, replace(act, changes=("minutes=30",))) == "change"
    assert act.policy == "imagenet-lite-early · act · spatial · minutes=30 + clock=true"


def test_numbers_in_what_was_changed_are_ordered_by_their_worth():
    one = Condition("grasp", "imagenet-lite-early", ("front_psm2",), recipe="act")
    budgets = [replace(one, changes=(f"minutes={minutes}",)) for minutes in (10, 2.5, 30, 3)]
    assert [condition.minutes for condition in sorted(budgets, key=order)] == [2.5, 3, 10, 30]
    early = [replace(one, encoder=f"vit-{size}") for size in (14, 8)]
    assert [item.encoder for item in sorted([one, *early], key=order)] == [
        "imagenet-lite-early",
        "vit-8",
        "vit-14",
    ]


def test_a_map_says_once_what_all_its_policies_share(groups):
    images = {"views": ("front_psm2",), "pool": "spatial"}
    kinds = {"best": "bc", "act": "act"}
    conditions = [
        Condition(task, "imagenet-lite-early", **images, recipe=recipe, trained_by=kind)
        for task in ("grasp", "place")
        for recipe, kind in kinds.items()
    ]
    mine = [replace(groups[0], condition=condition) for condition in conditions]
    (drawn,) = heat_maps(mine, {condition: at for at, condition in enumerate(conditions)})
    assert drawn["title"] == "front_psm2 · imagenet-lite-early · spatial"
    assert drawn["columns"] == ["best", "act"]
    (alone,) = heat_maps(mine[::2], {condition: at for at, condition in enumerate(conditions)})
    assert alone["title"] == "front_psm2"
    assert alone["columns"] == ["imagenet-lite-early · spatial · best"]


def test_a_map_says_all_of_all_alone(groups):
    result, row = groups[0].results[0], groups[0].rows[0]
    won = [{**row, "success": True}] * 299
    last = {"grasp": True, "place": False}
    mine = [
        replace(
            groups[0],
            condition=Condition(task, "imagenet-lite", ("front",)),
            results=(replace(result, rows=[*won, {**row, "success": success}]),),
        )
        for task, success in last.items()
    ]
    (drawn,) = heat_maps(mine, {item.condition: at for at, item in enumerate(mine)})
    cells = [cell["text"] for line in drawn["rows"] for cell in line["cells"]]
    assert cells == ["100", "99.7"]


def test_curves_procedure_and_probes_are_drawn_with_their_numbers(text, groups):
    for section in ("curves", "procedure", "probes"):
        assert f'<h2 id="{section}">' in text
    curves = text.split('id="curves"')[1].split('id="retention"')[0]
    assert curves.count('<svg class="curve"') == 3
    assert curves.count("<th>area (interval)</th>") == 2
    lite = [
        find(groups, task="place", encoder="imagenet-lite", axis="light", strength=s)
        for s in (0.25, 0.5, 1.0)
    ]
    area = statistics.area_under_curve((0.25, 0.5, 1.0), [item.rate for item in lite])
    assert re.search(rf"{area:.2f} \(0\.\d\d–0\.\d\d\)", curves.split("<h3>place: light</h3>")[1])
    item = find(groups, task="place", encoder="imagenet", axis="light", strength=0.5)
    assert f"{item.successes}/{item.episodes}" in curves
    procedure = text.split('id="procedure"')[1].split('id="probes"')[0]
    swapped = find(groups, task="suture", expert_swap="insert")
    finished = sum(row["stages"] > 2 for row in swapped.rows)
    assert f"{finished}/20" in procedure
    assert "expert in insert" in procedure
    probes = text.split('id="probes"')[1].split('id="pairs"')[0]
    assert re.search(r"handoff: -0\.\d\d over 9 pairs \(p [=&]", probes)
    assert probes.count('<svg class="curve"') == 1
    assert "(2.00–7.00; 9.50)" in probes


def test_a_high_level_policy_stands_once_with_its_errors(text):
    section = text.split('id="high-level"')[1].split('id="probes"')[0]
    assert section.count('<table class="heat">') == 1, "three evaluations share it"
    cells = re.findall(r"<b>(\d*)</b><small>(\d*)</small>", section)
    counted = [int(frames or 0) for _, frames in cells]
    assert counted == [count for row in STAGE_ERRORS.confusion for count in row]
    assert cells[0] == ("98", "412") and cells[18] == ("94", "377")
    assert "1910 of 1980 frames predicted correctly (96 %)" in section
    assert "calibration error 0.012; mean absolute error of the progress 0.046" in section


def test_a_shifted_policy_is_no_cell_of_the_tables(text, groups):
    assert not any(
        paper_comparison.paper_rate(item.condition) for item in groups if not item.condition.plain
    )
    assert text.count('data-plain="no"') == 2 * sum(not item.condition.plain for item in groups)


def test_shifted_evaluations_alone_make_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    generator = np.random.default_rng(0)
    for strength in (0.0, 0.5, 1.0):
        run = run_of("grasp", "random", ("front",), 0, shift=Shift("blur", strength))
        evaluation(tmp_path / "blur" / f"{strength:g}", run, 1.5 - strength, generator)
    text = report.write_report(tmp_path).read_text()
    assert "random on front solves 20 of 20 held-out starts of grasp" in text
    assert len(rows_of(text, "success")) == 3
    assert text.split('id="curves"')[1].count("<polyline") == 1


def test_shifted_evaluations_alone_have_a_best_policy_of_each_task(tmp_path):
    generator = np.random.default_rng(0)
    for task, strength in itertools.product(("grasp", "place"), (0.0, 1.0)):
        run = run_of(task, "imagenet", ("back",), 0, shift=Shift("light", strength))
        evaluation(tmp_path / task / f"light/{strength:g}", run, 0.9 - strength, generator)
    told = page.headline(group(collect(tmp_path)))
    assert told["headline"].startswith("The best trained policy of each of 2 tasks solves")
    assert "grasp 1" in told["lead"] and "place 1" in told["lead"]


def test_one_task_with_a_trained_policy_is_named(tmp_path):
    generator = np.random.default_rng(0)
    evaluation(tmp_path / "a", run_of("grasp", "imagenet", ("back",), 0), 0.9, generator)
    expert = RunConfig(TaskConfig("place"), policy="expert")
    evaluation(tmp_path / "b", expert, 1.5, generator)
    told = page.headline(group(collect(tmp_path)))
    assert told["headline"].startswith("The best trained policy of grasp solves")


def test_only_a_policy_that_was_chosen_among_several_is_called_the_best_of_them(tmp_path):
    generator = np.random.default_rng(0)
    for task in ("grasp", "place"):
        evaluation(tmp_path / task, run_of(task, "imagenet", ("back",), 0), 0.9, generator)
    told = page.headline(group(collect(tmp_path)))
    assert "optimistic" not in told["lead"]
    evaluation(tmp_path / "other", run_of("place", "random", ("back",), 0), 0.9, generator)
    told = page.headline(group(collect(tmp_path)))
    assert "That of place is the best of several" in told["lead"]
    of_place = [item for item in group(collect(tmp_path)) if item.condition.task == "place"]
    assert "It is the best of several" in page.headline(of_place)["lead"]
    assert "optimistic" not in page.headline(of_place[:1])["lead"]


def test_the_copies_of_a_plain_evaluation_are_one_policy(tmp_path):
    generator = np.random.default_rng(0)
    for axis, strength in itertools.product(("blur", "light"), (0.0, 1.0)):
        run = run_of("grasp", "imagenet", ("back",), 0, shift=Shift(axis, strength))
        evaluation(tmp_path / axis / f"{strength:g}", run, 0.9, generator)
    told = page.headline(group(collect(tmp_path)))
    assert "For comparison" not in told["lead"] and "best of several" not in told["lead"]
    assert "blur" not in told["headline"] and "light" not in told["headline"]


def test_a_policy_that_was_measured_twice_is_compared_with_others(tmp_path):
    generator = np.random.default_rng(0)
    for place, encoder, rate, count in (
        ("few", "imagenet", 1.5, 10),
        ("many", "imagenet", 1.5, 20),
        ("other", "random", -0.5, 20),
    ):
        run = run_of("grasp", encoder, ("back",), 0)
        evaluation(tmp_path / place, run, rate, generator, episodes=count)
    groups = group(collect(tmp_path))
    pairs = [(pair.factor, pair.episodes) for pair in compare(groups)]
    assert sorted(pairs) == [("encoder", 10), ("encoder", 20), ("place", 10)]
    beside = {row[1]: row[2] for row in paper_comparison.beside_paper(groups)}
    _, (_, shown) = beside["imagenet"]
    assert shown is not None and shown.episodes == 20


@pytest.mark.parametrize(("counts", "told"), [((4, 4), "by seed 4, 4"), ((4, 2), "4/4, 2/2")])
def test_seeds_with_other_numbers_of_episodes_say_of_how_many(tmp_path, counts, told):
    generator = np.random.default_rng(0)
    for seed, count in enumerate(counts):
        run = run_of("grasp", "imagenet", ("back",), seed)
        evaluation(tmp_path / str(seed), run, 5.0, generator, episodes=count)
    (item,) = group(collect(tmp_path))
    assert item.across_text().endswith(told)


def test_training_seeds_of_two_sweeps_stay_together(tmp_path):
    generator = np.random.default_rng(0)
    for sweep, seeds in (("first", (0, 1, 2)), ("second", (0, 1))):
        for seed in seeds:
            run = run_of("grasp", "imagenet", ("back",), seed)
            evaluation(tmp_path / sweep / "runs" / f"k{seed}" / "evaluation", run, 0.5, generator)
    groups = group(collect(tmp_path))
    found = {item.condition.place: [result.seed for result in item.results] for item in groups}
    assert found == {"first": [0, 1, 2], "second": [0, 1]}


def test_a_probe_counts_each_held_out_start_once(tmp_path):
    generator = np.random.default_rng(0)
    run = run_of("grasp", "imagenet", ("back",), 0)
    for place in ("a", "b"):
        evaluation(tmp_path / place, run, 0.5, generator)
    tried = episode("grasp", run.name, names.VALIDATION_SEED, True, generator)
    stored = replace(run, starts=Starts(names.VALIDATION_SEED, 1))
    write_evaluation(tmp_path / "c", [tried], stored, {})
    probe = {"task": "grasp", "encoder": "imagenet", "view": "back", "tip_mm": 3.0}
    (row,) = probes.probes([probe], group(collect(tmp_path))).rows
    assert row.success.endswith("/20")


def test_hierarchical_policies_differ_as_a_whole():
    for views in ((), ("front",)):
        first, second = (
            Condition("suture", f"hierarchical-{name}", views, "learned") for name in "ab"
        )
        assert factor(first, second) == "hierarchical policy"


@pytest.mark.parametrize("strength", [0.0, 0.25, 0.5, 0.75])
def test_a_shift_stands_in_the_world_that_it_was_added_to(strength):
    trained = run_of("grasp", "imagenet", ("back",), 0)
    for axis, more in (("light", {}), ("light", {"light": 0.1}), ("latency", {"latency": 1})):
        varies = RandomisationConfig(phantom_shift=10.0, **more)
        world = TaskConfig("grasp", randomisation=varies)
        plain = evaluated_in(trained, world)
        shifted = shifted_config(world, AXES[axis], strength)
        run = evaluated_in(plain, shifted, Shift(axis, strength))
        found = condition_of(run)
        assert replace(found, axis="", strength=0.0) == condition_of(plain)
        # A policy of that world, and what a plan says of it before it is shifted.
        own = replace(trained, env=world)
        for env in (world, shifted):
            found = condition_of(evaluated_in(own, env, Shift(axis, strength)))
            assert replace(found, axis="", strength=0.0) == condition_of(own)


def test_two_evaluations_of_the_same_thing_are_not_counted_as_one(tmp_path):
    generator = np.random.default_rng(0)
    for name in ("friction", "attach"):
        evaluation(tmp_path / name, EXPERT, 1.5, generator)
    assert [(item.label, item.episodes) for item in group(collect(tmp_path))] == [
        ("expert · attach", 20),
        ("expert · friction", 20),
    ]


def test_what_a_running_sweep_has_not_filed_is_no_result_yet(tmp_path):
    write_sweep(tmp_path, tasks=("grasp",), seeds=(0,), views=(("back",),))
    before = len(collect(tmp_path).results)
    evaluation(tmp_path / "work/job/evaluation", EXPERT, 1.5, np.random.default_rng(0))
    assert len(collect(tmp_path).results) == before


def test_films_show_every_condition_and_stay_within_the_budget(text, groups, written, monkeypatch):
    assert (written / "report.html").stat().st_size < LIMIT
    details = json.loads(text.split('id="details">')[1].split("</script>")[0])
    assert len(details) == len(groups)
    assert all(entry["films"] for entry, item in zip(details, groups, strict=True) if item.episodes)
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    monkeypatch.setattr(filmstrips, "BUDGET", 100_000)
    reel = filmstrips.make_reel(groups)
    assert (
        0 < sum(len(frame) for strip in reel.strips.values() for frame in strip.frames) <= 100_000
    )
    assert reel.wanted > len(reel.strips)
    assert filmstrips.make_reel(groups, most=0).strips == {}


def test_the_compared_start_is_one_and_shows_successes_and_failures(groups):
    chosen = filmstrips.comparison(groups, "insert")
    assert len({choice.row["seed"] for choice in chosen}) == 1
    assert {choice.row["success"] for choice in chosen} == {True, False}
    assert 2 < len(chosen) <= filmstrips.COMPARED
    assert len({choice.group.label for choice in chosen}) == len(chosen)


def test_details_tell_every_episode(text, groups):
    details = json.loads(text.split('id="details">')[1].split("</script>")[0])
    for entry, item in zip(details, groups, strict=True):
        for told, result in zip(entry["cells"], item.results, strict=True):
            assert told["outcomes"].count("s") == result.summary["successes"]
            assert (
                len(told["outcomes"]) == len(told["steps"]) == len(told["mm"]) == len(result.rows)
            )
            assert told["starts"] == result.rows[0]["seed"]
            assert told["commands"][-1] == COMMAND


def test_failures_are_those_of_the_best_policy_of_each_task_once_a_kind(
    written, groups, monkeypatch
):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    reel, drawn = filmstrips.make_reel(groups), []
    monkeypatch.setattr(
        contact_sheet, "sheet", lambda rows, columns, title: drawn.append(rows) or Figure()
    )
    assert failure_sheet(groups, reel)
    titles = [title.split() for title, _ in drawn[0]]
    best = {task: best_trained(of_task(groups, task)) for task in names.TASKS}
    for task, start, *_ in titles:
        lost = [
            row
            for r in best[task].results
            for row in r.rows
            if row["seed"] == int(start) and not row["success"]
        ]
        assert lost, "a failure of the best"
    kinds = [(task, *outcome) for task, _, *outcome in titles]
    assert len({kind[:2] for kind in kinds}) == len(kinds), "each kind once"
    assert len({len(frames) for _, frames in drawn[0]}) == 1
    assert failure_sheet(groups, filmstrips.Reel()) is None
    assert contact_sheet.decoded((written / "tables/failures.jpg").read_bytes()).shape[2] == 3


def test_page_and_tables_are_the_same_each_time(written, text, monkeypatch):
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)
    before = {path.name: path.read_bytes() for path in (written / "tables").iterdir()}
    assert report.write_report(written).read_text() == text
    assert {path.name: path.read_bytes() for path in (written / "tables").iterdir()} == before


def test_latex_has_the_structure_of_booktabs(written):
    latex = (written / "tables/table.tex").read_text()
    assert r"\usepackage{booktabs}" in latex.splitlines()[0]
    depth = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", latex):
        if kind == "begin":
            depth.append(name)
        else:
            assert depth.pop() == name
    assert not depth
    found = re.findall(r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", latex, re.DOTALL)
    assert len(found) == 2
    for columns, body in found:
        assert [body.count(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")] == [
            1,
            1,
            1,
        ]
        assert r"\hline" not in body
        rows = [
            line for line in body.splitlines() if line.endswith(r"\\") and "multicolumn" not in line
        ]
        assert len(rows) > 10
        assert all(len(re.findall(r"(?<!\\)&", row)) == len(columns) - 1 for row in rows)
    plain = latex.replace("% needs", "")
    assert not re.search(r"(?<!\\)[%#]", plain)
    assert not re.search(r"(?<!\\)_", re.sub(r"\\label\{[^}]*\}", "", plain))
    assert plain.count("{") - plain.count(r"\{") == plain.count("}") - plain.count(r"\}")


@pytest.mark.skipif(
    shutil.which("pdflatex") is None, reason="no TeX here (texlive-latex-recommended)"
)
def test_latex_compiles(written, tmp_path):
    kind, packages = r"\documentclass{article}", r"\usepackage{booktabs}"
    body = (written / "tables/table.tex").read_text()
    strange = formats.escape_latex("".join(formats._LATEX))
    (tmp_path / "paper.tex").write_text(
        "\n".join([kind, packages, r"\begin{document}", strange, body, r"\end{document}"])
    )
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "paper.pdf").read_bytes().startswith(b"%PDF")


def test_latex_escapes_what_it_would_read_as_a_command():
    assert (
        formats.escape_latex("50 % of a_b & {c} ~ \\x")
        == r"50 \% of a\_b \& \{c\} \textasciitilde{} \textbackslash{}x"
    )


def test_markdown_and_csv_hold_the_same_numbers(written, groups):
    lines = (written / "tables/table.md").read_text().splitlines()
    starts = [at for at, line in enumerate(lines) if line.startswith("| ---")]
    assert len(starts) == 3  # next to the paper, success, cells without a result
    for at in starts:
        width = lines[at].count("|")
        block = [line for line in lines[at:] if line.startswith("|")]
        assert len(re.findall(r"(?<!\\)\|", lines[at - 1])) == width
        assert len(re.findall(r"(?<!\\)\|", block[1])) == width
    with open(written / "tables/table.csv", newline="") as file:
        records = list(csv.DictReader(file))
    assert len(records) == len(groups)
    for record, item in zip(records, groups, strict=True):
        assert int(record["episodes"]) == item.episodes
        if item.episodes:
            assert float(record["rate"]) == item.rate
    with open(written / "tables/pairs.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(compare(groups))


def test_text_in_a_heat_map_can_be_read():
    def luminance(colour):
        channels = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    steps = [charts.heat(rate / 100) for rate in range(101)]
    for back, front in steps:
        light, dark = sorted((luminance(back), luminance(front)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) > 4.5
    values = [luminance(back) for back, _ in steps]
    assert all(a >= b for a, b in itertools.pairwise(values)), "lightness alone carries the value"


@given(st.lists(st.floats(0, 1e5, allow_nan=False).map(lambda x: round(x, 3)), min_size=1).map(set))
def test_an_axis_has_few_marks_with_room_for_each(xs):
    xs = sorted(xs)
    marks = charts._marks(xs)
    assert len(marks) <= charts.FEW_MARKS + 1
    assert all(xs[0] <= mark <= xs[-1] for mark in marks)
    if marks != xs:
        steps = np.diff(marks)
        assert np.allclose(steps, steps[:1]), "evenly spaced"


def test_an_axis_is_marked_at_round_numbers_where_its_points_are_not():
    assert charts._marks([2.5, 5, 7.5]) == [2.5, 5, 7.5]
    assert charts._marks([0.563333, 1.22, 3.16333, 5.11]) == [1, 2, 3, 4, 5]
    assert charts._marks([2.5 * n for n in range(1, 21)]) == [10, 20, 30, 40, 50]


def test_page_stands_alone(text):
    assert_stands_alone(text)
