"""Plans: a set of policies rebuilt from scratch for several training seeds, tiny, end to end."""

import itertools
import json
import multiprocessing
import operator
import os
import shutil
import signal
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.commands.main import main
from surgicai_vision.commands.sweep import read_experiment
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.files import configs_folder
from surgicai_vision.demos.store import list_demos, read_demo
from surgicai_vision.evaluation.storage import read_evaluation, read_rows
from surgicai_vision.experiments.dataset_config import SEEDS_EACH, TRAINING_SEEDS, first_seed
from surgicai_vision.experiments.plan_config import plan_of
from surgicai_vision.experiments.sweep.driver import run_sweep
from surgicai_vision.experiments.sweep.plan import Jobs, plan, read_experiment_of
from surgicai_vision.experiments.sweep.selection import read_choice
from surgicai_vision.report import collect
from surgicai_vision.report.groups import group
from surgicai_vision.report.pairs import compare
from surgicai_vision.training.checkpoint import read_checkpoint

WHOLE = {"demonstrations": "whole", "change": ["frame_stride=10"]}
VARIED = {"randomisation": {"phantom_shift": 3.0}}
TABLE = {
    "size": 32,
    "encoder": "random-conv",
    "pool": "spatial",
    "recipe": "best",
    "seed": [0, 1],
    "episodes": 2,
    "epochs": 1,
    "procedure": {"max_steps": 20, "steps": 10, "termination": "learned"},
    "demonstrations": [
        {
            "name": "whole",
            "task": "suture",
            "episodes": 2,
            "view": ["back"],
            "frame_stride": 10,
            "env": VARIED,
        },
        {
            "name": "own",
            "task": "place",
            "episodes": 2,
            "view": ["back"],
            "noise": 0.3,
            "env": VARIED,
            "visits_of": "whole",
        },
    ],
    "policies": [
        {"name": "first", "part": "grasp", "subtask": "grasp", "view": ["back"], **WHOLE},
        {"name": "place", "demonstrations": "own", "recipe": "paper", "change": ["frame_stride=5"]},
        *({"name": name, "subtask": name, **WHOLE} for name in names.SUBTASKS[2:]),
        {"name": "hlp", "policy": "hlp", **WHOLE},
    ],
    "conditions": [
        {"name": "standing", "policies": ["place", "suture"]},
        {
            "name": "moved",
            "policies": ["suture"],
            "env": {"randomisation": {"phantom_shift": 10.0, "phantom_turn": 15.0}},
        },
        {
            "name": "privileged",
            "policies": ["suture"],
            "procedure": {"termination": "privileged", "handoff": "expert"},
        },
        {"name": "upset", "policies": ["suture"], "upset": True, "seed": [1], "episodes": 1},
    ],
}
RUNS = 2 * 4 + 1
QUIET = QuietConsole().stage


@contextmanager
def eventful(title, unit):
    """Kill a worker after the first policy, and interrupt after the first run."""

    def progress(done, total, unit=""):
        if title == "policies" and done == 1:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)
        if title == "runs" and done == 1:
            raise KeyboardInterrupt

    yield progress


def sweep(built, out, workers=0, stage=QUIET, only=()):
    context = RunContext(workers, stage=stage)
    return run_sweep(built, out, context, choice=read_choice(only, built.runs))


def counts(result):
    return tuple(result[name] for name in ("runs", "done", "cached", "failed", "not_run", "left"))


@pytest.fixture(scope="module")
def tiny():
    """The plan of this module's tests."""
    return plan_of(TABLE, "a test")


@pytest.fixture(scope="module")
def quiet(tiny, tmp_path_factory):
    """The plan's folder, built without interruption, and the call's result."""
    out = tmp_path_factory.mktemp("plan") / "quiet"
    return out, sweep(tiny, out)


def seeds_of(folder):
    """Return the start seeds of every demonstration below a folder."""
    return {read_demo(path).seed for demos in folder.glob("*/demos") for path in list_demos(demos)}


def test_training_seeds_share_no_demonstration_and_meet_no_evaluation(quiet):
    out, _ = quiet
    first, second = (seeds_of(out / "data" / f"seed{seed}") for seed in (0, 1))
    assert first and second and not first & second
    assert first <= set(range(first_seed(0), first_seed(0) + SEEDS_EACH))
    assert second <= set(range(first_seed(1), first_seed(1) + SEEDS_EACH))
    bounds = [first_seed(seed) for seed in range(TRAINING_SEEDS)]
    assert {b - a for a, b in itertools.pairwise(bounds)} == {SEEDS_EACH}
    assert bounds[0] == names.TRAIN_SEED and bounds[-1] + SEEDS_EACH <= 400_000
    for seed in (-1, TRAINING_SEEDS):
        with pytest.raises(InputError, match="allowed: 0 to 19"):
            first_seed(seed)


def test_a_field_of_an_env_stands_whole_in_the_place_of_the_plans_and_the_others_stay():
    standing = {"name": "standing", "env": {"randomisation": {}}}
    turned = {"name": "turned", "env": {"randomisation": {"camera_turn": 1.0}}}
    dense = {"name": "dense", "env": {"reward": "dense"}}
    env = {"tolerance": "released", "randomisation": {"phantom_shift": 2.0}}
    plan = plan_of({**TABLE, "env": env, "conditions": [standing, turned, dense]}, "a test")
    worlds = {condition.name: plan.task_config("place", condition) for condition in plan.conditions}
    assert {world.tolerance for world in worlds.values()} == {"released"}
    assert worlds["standing"].randomisation == RandomisationConfig()
    assert worlds["turned"].randomisation == RandomisationConfig(camera_turn=1.0)
    assert worlds["dense"].randomisation == RandomisationConfig(phantom_shift=2.0)
    recorded = plan.recorded_env(plan.demonstrations[0])
    assert recorded.randomisation == RandomisationConfig(phantom_shift=3.0), "its own"
    assert recorded.tolerance == "released"


def test_a_step_limit_of_demonstrations_is_no_evaluations():
    """Each policy is evaluated with its task's limit, as in its key; the procedure has its own."""
    env = {"max_steps": 300, "hold_jaw": True}
    with_visits = {"hold_jaw": True}  # visits have their task's limit, and so have these
    recorded = [
        {**each, "env": with_visits if "visits_of" in each else env}
        for each in TABLE["demonstrations"]
    ]
    whole = {"name": "all", "view": ["back"], **WHOLE}  # one policy for the whole procedure
    table = {"demonstrations": recorded, "policies": [*TABLE["policies"], whole]}
    plan = plan_of({**TABLE, **table, "conditions": [{"name": "standing"}]}, "a test")
    for run in plan.runs:
        evaluated = plan.evaluated(run).env
        limit = None if run.is_hierarchical else run.env.max_steps
        assert evaluated.get("max_steps") == limit
        assert not evaluated["hold_jaw"] and not run.env.hold_jaw
    assert {run.env.max_steps for run in plan.runs if not run.is_hierarchical} == {200, 1000}


def test_everything_is_built_once_and_evaluated_on_the_same_starts(quiet, tiny):
    out, result = quiet
    assert counts(result) == (RUNS, RUNS, 0, 0, 0, 0), result["problems"]
    assert len(list((out / "policies").iterdir())) == 2 * 6, "each seed's six, shared by its runs"
    assert len(list(out.glob("data/*/*/dataset"))) == 2 * 2
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    assert {(row["training_seed"], row["condition"], row["task"]) for row in rows} == {
        (run.seed, run.condition, run.task) for run in tiny.runs
    }
    for state in plan(tiny, out):
        stored = read_evaluation(out / "runs" / state.key / "evaluation").run
        starts = [row["seed"] for row in read_rows(out / "runs" / state.key / "evaluation")]
        assert starts == [900_000, 900_001][: len(starts)]
        assert stored.condition == state.run.condition and stored.seed == state.run.seed
        world = stored.env.randomisation
        expected = (10.0, 15.0) if stored.condition == "moved" else (0.0, 0.0)
        assert (world.phantom_shift, world.phantom_turn) == expected, "whatever was trained on"
        if stored.is_hierarchical:
            ends = "privileged" if stored.condition == "privileged" else "learned"
            assert (stored.termination, stored.env.max_steps) == (ends, 20)
        assert stored.sees_goal == (stored.condition == "privileged"), "its expert does"
        assert not state.run.sees_goal, "a key is that of the planned run"
    assert read_experiment_of(out).table() == tiny.table()


def test_a_policy_is_trained_on_what_the_plan_says(quiet, tiny):
    out, _ = quiet
    jobs = Jobs(tiny, out)
    run = next(run for run in tiny.runs if run.is_hierarchical and run.seed == 1)
    trained = {
        name: read_checkpoint(jobs.policy_folder(part)) for name, part in tiny.parts(run).items()
    }
    assert set(trained) == {*names.SUBTASKS, "hlp"}
    assert {card.run.seed for card in trained.values()} == {1}
    assert trained["grasp"].run.views == ("back",) and not trained["insert"].run.views
    assert trained["place"].run.recipe == "paper" and trained["insert"].run.recipe == "best"
    assert trained["place"].run.noise == 0.3 and trained["insert"].run.noise == 0.6
    assert {card.run.env.randomisation.phantom_shift for card in trained.values()} == {3.0}
    assert trained["place"].run.demonstrations == 2 + 2, "its own, and the visits of two procedures"
    assert tiny.suture["grasp"].name == "first" and not tiny.suture["grasp"].acts
    privileged = next(run for run in tiny.runs if run.condition == "privileged")
    assert "handoff" not in tiny.parts(privileged), "the expert is in its place"


def test_the_result_depends_neither_on_workers_nor_on_kills(quiet, tiny, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(quiet[0] / "data/seed1", out / "data/seed1")  # recording is tested separately
    shutil.copy(quiet[0] / "sweep.json", out)
    only = ("seed=1", "condition=standing")
    with pytest.raises(KeyboardInterrupt):
        sweep(tiny, out, workers=1, stage=eventful, only=only)
    assert not multiprocessing.active_children()
    policies = {path: path.stat().st_mtime_ns for path in out.glob("policies/*/*.safetensors")}
    assert len(policies) == 6
    result = sweep(tiny, out, only=only)
    assert (result["failed"], result["done"] + result["cached"]) == (0, 2)
    assert {path: path.stat().st_mtime_ns for path in policies} == policies, "none trained again"
    assert not (out / "work").exists()
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    whole = pq.read_table(quiet[0] / "episodes.parquet").to_pylist()
    key = operator.itemgetter("training_seed", "condition")
    assert [json.dumps(row) for row in rows] == [
        json.dumps(row) for row in whole if key(row) == (1, "standing")
    ]


def test_a_finished_plan_does_nothing_and_a_part_can_be_chosen(quiet, tiny, tmp_path):
    out, first = quiet
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    again = sweep(tiny, out)
    assert (counts(again), again["digest"]) == ((RUNS, 0, RUNS, 0, 0, 0), first["digest"])
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert {path.name for path in after if after[path] != before.get(path)} == {"episodes.parquet"}
    with pytest.raises(OutputExists, match="another sweep"):
        sweep(replace(tiny, epochs=2), out)
    choice = read_choice(("seed=1", "condition=moved"), tiny.runs)
    states = [state.state for state in plan(tiny, tmp_path, choice)]
    assert (states.count("to do"), states.count("left")) == (1, RUNS - 1)


def test_seeds_and_conditions_may_be_added_and_nothing_changed(tiny):
    stored = tiny.table()
    condition = replace(tiny.conditions[0], name="more", episodes=1)
    more = replace(tiny, seed=(0, 1, 5), conditions=(*tiny.conditions, condition))
    assert tiny.extends(stored) and more.extends(stored)
    assert set(tiny.runs) < set(more.runs), "what is done stays done"
    assert not tiny.extends(more.table())
    changed = replace(tiny.conditions[0], episodes=1)
    for other in (
        replace(tiny, conditions=(changed, *tiny.conditions[1:])),
        replace(tiny, procedure={**tiny.procedure, "patience": 5}),
        replace(tiny, recipe="paper"),
    ):
        assert not other.extends(stored)


def test_the_report_pairs_conditions_over_training_seeds(quiet, tiny, capsys):
    out, _ = quiet
    groups = {(item.condition.task, item.condition.name): item for item in group(collect(out))}
    assert len(groups) == 5
    standing = groups["suture", "standing"]
    assert [result.seed for result in standing.results] == [0, 1]
    assert standing.across is not None and standing.episodes == 4
    pairs = {
        frozenset((pair.first.condition.name, pair.second.condition.name)): pair
        for pair in compare(list(groups.values()))
    }
    assert {pair.factor for pair in pairs.values()} == {"condition"}
    assert pairs[frozenset(("standing", "moved"))].episodes == 4
    assert pairs[frozenset(("standing", "privileged"))].episodes == 4, "paired though ends differ"
    assert pairs[frozenset(("standing", "upset"))].episodes == 1
    assert main(["report", str(out), "--strips", "0"]) == 0
    cells = pq.read_table(out / "tables/cells.parquet").to_pylist()
    assert len(cells) == RUNS and {cell["state"] for cell in cells} == {"done"}
    assert {cell["condition"] for cell in cells} == {each.name for each in tiny.conditions}


def test_a_file_is_tried_small_beside_the_whole(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("headline.yaml").write_text(yaml.safe_dump(TABLE))
    small = ("--demonstrations", "1", "--episodes", "1", "--size", "48")
    assert main(["sweep", "headline.yaml", *small, "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["runs"] == told["to_do"] == RUNS and not Path("outputs").exists()
    built = read_experiment(Path("headline.yaml")).smaller(1, 3, 1, 48)
    assert {each.demonstrations.episodes for each in built.datasets.values()} == {1}
    assert {run.starts.episodes for run in built.runs} == {1}
    trained = [part.run for run in built.runs for part in built.parts(run).values()]
    assert all(run.changes[-1] == "epochs=3" for run in trained)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"seed": [0, 20]}, "allowed: 0 to 19"),
        ({"seed": [0, 0]}, "each once"),
        ({"seed": []}, "at least one"),
        ({"starts": "training"}, "bank of starts"),
        ({"conditions": [{"name": "a", "policies": ["hlp"]}]}, "'hlp'"),
        ({"conditions": [{"name": "a", "seed": [7]}]}, "training seed '7'"),
        ({"conditions": [{"name": "a", "env": {"task": "grasp"}}]}, "leave it out"),
        ({"conditions": [{"name": "a", "env": {"randomisation": {"licht": 1}}}]}, "'light'"),
        ({"conditions": [{"name": "a", "env": ["b"]}]}, "expected a table of keys"),
        ({"env": 5}, "expected a table of keys"),
        (
            {"demonstrations": [{**TABLE["demonstrations"][0], "env": {"task": "grasp"}}]},
            "demonstrations whole: env has 'task'",
        ),
        (
            {"demonstrations": [{**TABLE["demonstrations"][0], "env": {"advance": "told"}}]},
            "demonstrations whole: env has 'advance'",
        ),
        ({"conditions": [{"name": "a", "procedure": {"terminatoin": "x"}}]}, "'termination'"),
        ({"conditions": [{"name": "a"}, {"name": "a"}]}, "each once"),
        (
            {"demonstrations": [{**TABLE["demonstrations"][0], "upset_fraction": 2}]},
            "within 0 and 1",
        ),
        ({"demonstrations": [{**TABLE["demonstrations"][0], "episodes": 9999}]}, "1 to 4000"),
        (
            {
                "demonstrations": [
                    TABLE["demonstrations"][0],
                    {**TABLE["demonstrations"][1], "visits_of": "hole"},
                ]
            },
            "'whole'",
        ),
        (
            {"demonstrations": [{**TABLE["demonstrations"][0], "visits_of": "whole"}]},
            "task that is visited",
        ),
        (
            {"demonstrations": [{**TABLE["demonstrations"][1], "aim_noise": 1.0}]},
            "'place' has no goal to miss",
        ),
        ({"policies": [{**TABLE["policies"][0], "view": ["front"]}]}, "'front'"),
        ({"policies": [{**TABLE["policies"][0], "part": "grsp"}]}, "'grasp'"),
        ({"policies": [TABLE["policies"][0], {**TABLE["policies"][0], "name": "a"}]}, "each once"),
        (
            {
                "demonstrations": [
                    *TABLE["demonstrations"],
                    {**TABLE["demonstrations"][1], "name": "shaky", "jaw_noise": 1.0},
                ],
                "policies": [
                    *TABLE["policies"],
                    {**TABLE["policies"][1], "name": "other", "demonstrations": "shaky"},
                ],
                "conditions": [{"name": "standing"}],
            },
            "'place' and 'other' have the same run",
        ),
        ({"encoder": "imagenet-lit"}, "imagenet-lite"),
        ({"polices": []}, "'policies'"),
    ],
)
def test_a_wrong_plan_is_refused(changed, told):
    with pytest.raises(InputError, match=told):
        plan_of({**TABLE, **changed}, "a test")


def test_a_demonstrator_that_cannot_go_back_is_refused_before_any_work(tiny, tmp_path):
    demonstrations = tuple(
        each if each.task == "suture" else replace(each, demonstrator="recover", visits_of="")
        for each in tiny.demonstrations
    )
    with pytest.raises(InputError, match="Give task suture"):
        sweep(replace(tiny, demonstrations=demonstrations), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_misspelt_recipe_is_refused_before_any_work(tiny, tmp_path):
    policies = (replace(tiny.policies[0], recipe="bets"), *tiny.policies[1:])
    with pytest.raises(InputError, match="Did you mean 'best'"):
        sweep(replace(tiny, policies=policies), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_plan_of_a_single_seed_may_say_so_and_lists_no_conditions():
    table = {key: value for key, value in TABLE.items() if key != "conditions"}
    built = plan_of({**table, "seed": 0}, "a test")
    assert built.seed == (0,) and [each.name for each in built.conditions] == ["as trained"]


@pytest.mark.parametrize("name", ["procedure", "procedure-moved", "endoscope"])
def test_a_shipped_headline_is_a_whole_plan_of_three_seeds(name):
    built = read_experiment(configs_folder() / "sweep" / f"{name}.yaml")
    assert built.seed == (0, 1, 2) and names.SUTURE in built.names
    standing = [run for run in built.runs if run.condition == "standing"]
    assert {run.task for run in standing} == set(names.TASKS)
    assert {run.starts.seeds for run in standing} == {range(900_000, 900_100)}
    assert all(run.env.randomisation == RandomisationConfig() for run in standing)


def test_the_shipped_headline_of_a_moved_world_is_trained_and_counted_in_it():
    built = read_experiment(configs_folder() / "sweep" / "procedure-moved.yaml")
    worlds = [dataset.env.randomisation for dataset in built.datasets.values()]
    worlds += [run.env.randomisation for run in built.runs if run.condition == "moved"]
    for moved in worlds:
        assert (moved.phantom_shift, moved.phantom_turn) == (10.0, 15.0)
        assert (moved.camera_shift, moved.camera_turn, moved.kinematic_error) == (2.5, 2.5, 0.25)
