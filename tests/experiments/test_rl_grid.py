"""Sweeps over algorithms: the runs of the shipped files, and one sweep from its demonstrations."""

import json
import shutil
from dataclasses import replace

import pytest

from surgicai_vision.commands.sweep import grid_file, read_experiment
from surgicai_vision.core import names
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.executor import RunContext
from surgicai_vision.evaluation.storage import GRID_FILE, read_evaluation
from surgicai_vision.experiments.sweep import rl_jobs
from surgicai_vision.experiments.sweep.driver import run_sweep
from surgicai_vision.experiments.sweep.plan import CACHED, Jobs, plan, read_experiment_of, run_key
from surgicai_vision.experiments.sweep.rl_grid import RLGrid
from surgicai_vision.rl import train as training
from surgicai_vision.rl.algorithms import ALGORITHMS

SHIPPED = {
    "rl-online": 8 * 2 * 3,
    "rl-demonstrations": 4 * 5 * 3,
    "rl-offline": 5 * 5 * 3,
    "rl-offline-still": 3 * 5 * 3,
    "rl-ten-demonstrations": 5 * 2 * 3,
    "rl-hierarchy": 5 * 3 + 3,
}


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_files_stand_for_so_many_runs(name, tmp_path):
    grid = read_experiment(grid_file(name))
    assert isinstance(grid, RLGrid) and len(plan(grid, tmp_path)) == SHIPPED[name]
    for run in grid.runs:
        assert bool(run.demonstrations) == ALGORITHMS[run.algo].needs_demos
        assert bool(run.env_steps) == ALGORITHMS[run.algo].is_online
        assert run.starts.first_seed == names.TEST_SEED


def test_together_they_have_every_row_of_the_paper():
    found = {run.algo for name in SHIPPED for run in read_experiment(grid_file(name)).runs}
    assert found == set(ALGORITHMS)


def test_a_whole_procedure_shares_the_actors_of_its_seed(tmp_path):
    grid = read_experiment(grid_file("rl-hierarchy"))
    *actors, last = grid.runs
    parts = grid.parts(last)
    assert tuple(parts) == names.SUBTASKS and last.task == names.SUTURE
    for task, part in parts.items():
        (same,) = [run for run in actors if (run.task, run.seed) == (task, last.seed)]
        assert part.run == replace(same, starts=None)
    jobs = Jobs(grid, tmp_path)
    keys = {jobs.policy(part).key() for part in parts.values()}
    assert len(keys) == 5 and set(jobs.run(last).inputs) == keys
    for run in (run for run in actors if run.task != names.SUTURE):  # not trained again
        assert jobs.run(run).inputs == tuple(jobs.policy(p).key() for p in grid.parts(run).values())
        assert len(jobs.run(run).inputs) == 1


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"algo": ("td4",)}, UnknownName),
        ({"task": ("suture",)}, UnknownName),
        ({"change": {"bc": ["goals=3"]}}, UnknownName),
        ({"change": {"bc": "hidden=3"}}, InputError),
        ({"change": {"grasp": ["goals=3"]}}, UnknownName),
        ({"change": {"graps": ["gamma=0.9"]}}, UnknownName),
        ({"hierarchical": True}, InputError),
        ({"env_steps": 0}, InputError),
        ({"seed": (0, 2**32)}, InputError),
        ({"noise": 2.0}, InputError),
    ],
)
def test_what_cannot_be_run_is_refused_at_once(changes, error):
    with pytest.raises(error):
        RLGrid(**{"task": ("grasp",), "algo": ("bc",), **changes})


@pytest.mark.parametrize("line", ["change: 5", "env: foo"])
def test_a_table_of_another_kind_is_refused(line, tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text(f"task: grasp\nalgo: bc\n{line}\n")
    with pytest.raises(InputError, match="expected a table of keys"):
        read_experiment(path)


def test_an_algorithm_without_demonstrations_has_one_procedure_whatever_their_numbers():
    grid = RLGrid(names.SUBTASKS, ("ppo", "td3-bc"), demonstrations=(50, 100), hierarchical=True)
    procedures = [(run.algo, run.demonstrations) for run in grid.runs if run.is_hierarchical]
    assert procedures == [("ppo", None), ("td3-bc", 50), ("td3-bc", 100)]


def test_a_task_has_changes_of_its_own_in_rows_and_procedures():
    grid = RLGrid(
        names.SUBTASKS,
        ("td3-her-bc",),
        change={"td3-her-bc": ["success_steps=15"], "pullout": ["tolerance_share=0.5"]},
        hierarchical=True,
    )
    *actors, procedure = grid.runs
    found = {run.task: run.changes for run in actors}
    assert found.pop("pullout") == ("success_steps=15", "tolerance_share=0.5")
    assert set(found.values()) == {("success_steps=15",)} == {procedure.changes}
    parts = grid.parts(procedure)
    for run in actors:
        assert grid.parts(run)[run.task] == parts[run.task]
        assert parts[run.task].run.changes == run.changes
    assert "pullout with tolerance_share=0.5" in grid.text


def test_tasks_algorithms_and_seeds_may_be_added_later():
    small = RLGrid(("grasp",), ("bc",))
    larger = replace(small, seed=(0, 1), algo=("iql", "bc"), task=("grasp", "insert"))
    assert larger.extends(small.table()) and not small.extends(larger.table())
    assert not replace(larger, updates=5).extends(small.table())


def test_a_killed_sweep_goes_on_inside_the_training(tmp_path, monkeypatch):
    grid = RLGrid(
        ("grasp",),
        ("bc",),
        demonstrations=(1,),
        change={"bc": ["batch_size=16"]},
        updates=6,
        validation=0,
        save_every=2,
        episodes=1,
    )
    whole = run_sweep(grid, tmp_path / "whole", RunContext(0))
    shutil.copytree(tmp_path / "whole" / "data", tmp_path / "killed" / "data")
    shutil.copy(tmp_path / "whole" / GRID_FILE, tmp_path / "killed" / GRID_FILE)
    saved = []
    original = training._save

    def save(learner, *arguments):
        original(learner, *arguments)
        saved.append(learner.done)
        if saved == [2]:
            raise KeyboardInterrupt

    monkeypatch.setattr(training, "_save", save)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(grid, tmp_path / "killed", RunContext(0))
    again = run_sweep(grid, tmp_path / "killed", RunContext(0))
    assert saved == [2, 4]  # not from the beginning
    assert again["done"] == 1 and again["digest"] == whole["digest"]


def test_an_actor_trained_before_is_counted_and_not_trained_again(tmp_path, monkeypatch):
    grid = RLGrid(
        ("grasp",), ("bc",), demonstrations=(1,), updates=4, validation=0, save_every=4, episodes=1
    )
    run_sweep(grid, tmp_path / "sweep", RunContext(0))
    (run,) = grid.runs
    before = tmp_path / "sweep" / "runs" / run_key(run)

    def train(*arguments, **options):
        raise AssertionError("trained again")

    monkeypatch.setattr(rl_jobs, "train", train)
    rl_jobs.train_and_evaluate(
        tmp_path / "again",
        to_mapping(run),
        str(tmp_path / "again"),
        {"grasp": str(before / "policy")},
        processes=1,
        decisions=0,
        validation=0,
        save_every=4,
        demos="",
        scratch=str(tmp_path / "scratch"),
        command="",
        environment={},
    )
    weights = "policy/policy.safetensors"
    assert (tmp_path / "again" / weights).read_bytes() == (before / weights).read_bytes()
    stored = read_evaluation(tmp_path / "again" / "evaluation")
    assert stored.summary == read_evaluation(before / "evaluation").summary


def test_a_sweep_trains_counts_and_is_not_done_twice(tmp_path):
    grid = RLGrid(
        ("grasp",),
        ("bc", "sac"),
        demonstrations=(2,),
        change={
            "bc": ["batch_size=16"],
            "sac": ["batch_size=16", "learning_starts=10"],
        },
        env={"max_steps": 120},
        env_steps=24,
        updates=8,
        validation=1,
        save_every=12,
        episodes=2,
    )
    out = tmp_path / "sweep"
    result = run_sweep(grid, out, RunContext(0))
    assert (result["done"], result["failed"]) == (2, 0), result["problems"]
    assert {state.state for state in plan(read_experiment_of(out), out)} == {CACHED}
    assert not list((out / "unfinished").iterdir())
    for run in grid.runs:
        folder = out / "runs" / run_key(run)
        stored = read_evaluation(folder / "evaluation")
        assert stored.run == run and stored.summary["episodes"] == 2
        curve = json.loads((folder / "policy" / "curve.json").read_text())
        assert [point["episodes"] for point in curve] == [1] * (2 if run.algo == "sac" else 1)
    again = run_sweep(grid, out, RunContext(0))
    assert (again["done"], again["cached"], again["digest"]) == (0, 2, result["digest"])
