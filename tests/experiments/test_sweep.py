"""Sweeps on the executor: killed, interrupted, failing, continued.

Whatever happens, each run is done once and the digest is the same.
"""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.commands.main import main
from surgicai_vision.commands.sweep import read_grid
from surgicai_vision.core import files, names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.core.executor import JOBS, RunContext
from surgicai_vision.core.executor.store import LOCK
from surgicai_vision.dataset import open_dataset
from surgicai_vision.dataset.codecs import DEPTH_FAR, DEPTH_NEAR, grey
from surgicai_vision.dataset.subset import first_episodes, with_frame_stride
from surgicai_vision.evaluation.finished import FinishedEpisodes
from surgicai_vision.evaluation.storage import FORMAT, GRID_FILE, OURS, read_evaluation
from surgicai_vision.experiments.sweep import driver
from surgicai_vision.experiments.sweep.driver import run_sweep
from surgicai_vision.experiments.sweep.estimate import estimate
from surgicai_vision.experiments.sweep.grid import Grid, parts_of
from surgicai_vision.experiments.sweep.lerobot import _arguments
from surgicai_vision.experiments.sweep.plan import Jobs, plan, read_experiment_of, run_key
from surgicai_vision.experiments.sweep.rl_grid import RLGrid
from surgicai_vision.experiments.sweep.selection import read_choice
from surgicai_vision.report import collect
from surgicai_vision.report.experiment_key import condition_of
from surgicai_vision.training import policies
from surgicai_vision.training.checkpoint import read_checkpoint
from surgicai_vision.training.run_config import OWN, RunConfig, Starts

QUIET = QuietConsole().stage
BLIND = Grid(
    ("grasp",),
    (),
    (),
    proprioception=True,
    seed=(0, 1),
    demonstrations=(1, 2),
    epochs=1,
    episodes=1,
    size=32,
)
"""Four runs without images: half a second each."""
GROWING = RLGrid(("grasp",), ("bc",), seed=(0, 1), demonstrations=(1,), updates=2, episodes=1)
"""A sweep to which seeds may be added."""


def sweep(grid, out, workers=0, stage=QUIET, only=()):
    context = RunContext(workers, stage=stage)
    return run_sweep(grid, out, context, choice=read_choice(only, grid.runs))


def store_table(experiment, out):
    """Write the experiment's table into a folder."""
    out.mkdir(exist_ok=True)
    files.write_json(out / GRID_FILE, {"format": FORMAT, experiment.kind: dict(experiment.table())})


def counts(result):
    return tuple(result[name] for name in ("runs", "done", "cached", "failed", "not_run", "left"))


@contextmanager
def eventful(title, unit):
    """Kill a worker after the first run, and interrupt the sweep after the third."""

    def progress(done, total, unit=""):
        if title == "runs" and done == 1:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)
        if title == "runs" and done == 3:
            raise KeyboardInterrupt

    yield progress


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """A finished sweep, and its result."""
    out = tmp_path_factory.mktemp("sweep") / "quiet"
    return out, sweep(BLIND, out)


def test_a_killed_and_interrupted_sweep_ends_as_a_quiet_one(quiet, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        sweep(BLIND, out, workers=2, stage=eventful)
    assert not multiprocessing.active_children()
    assert 1 <= len(list(out.glob("runs/*/result.json"))) < 4
    result = sweep(BLIND, out, workers=2)
    assert (
        result["failed"] == 0 and result["done"] + result["cached"] == 4 and result["cached"] >= 2
    )
    assert result["digest"] == quiet[1]["digest"], (
        "whatever the workers, and whatever happened to them"
    )
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    assert len(rows) == len({(row["run"], row["seed"]) for row in rows}) == 4
    assert not (out / "work").exists()


def test_a_training_that_was_interrupted_continues_in_the_next_call(tmp_path, monkeypatch):
    grid = replace(BLIND, seed=(0,), demonstrations=(2,), epochs=12, expert=False)
    quiet = sweep(grid, tmp_path / "quiet")
    out = tmp_path / "out"
    epochs = []

    @contextmanager
    def interrupted(title, unit):
        def progress(done, total, unit=""):
            if title.startswith("policy: ") and done == 7:
                raise KeyboardInterrupt

        yield progress

    @contextmanager
    def noted(title, unit):
        def progress(done, total, unit=""):
            if title.startswith("policy: "):
                epochs.append(done)

        yield progress

    monkeypatch.setattr("surgicai_vision.experiments.sweep.jobs.silent_stage", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sweep(grid, out)
    assert not list(out.glob("runs/*"))
    monkeypatch.setattr("surgicai_vision.experiments.sweep.jobs.silent_stage", noted)
    again = sweep(grid, out)
    assert epochs[0] == 5 and epochs[-1] == 12, "from the state that the interrupted call left"
    assert again["digest"] == quiet["digest"]
    assert not list((out / "unfinished").iterdir()), "the state is removed with the result"


def test_an_evaluation_that_was_interrupted_continues_in_the_next_call(tmp_path, monkeypatch):
    grid = replace(BLIND, seed=(0,), demonstrations=(2,), episodes=3, expert=False)
    quiet = sweep(grid, tmp_path / "quiet")
    out = tmp_path / "out"
    kept = FinishedEpisodes.keep
    seeds = []

    def interrupted(self, episode):
        kept(self, episode)
        raise KeyboardInterrupt

    def noted(self, episode):
        kept(self, episode)
        seeds.append(episode.row.seed)

    monkeypatch.setattr(FinishedEpisodes, "keep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sweep(grid, out)
    assert not list(out.glob("runs/*"))
    assert len(list(out.glob("unfinished/*/evaluation/finished/*"))) == 1
    monkeypatch.setattr(FinishedEpisodes, "keep", noted)
    again = sweep(grid, out)
    assert len(seeds) == 2, "the third was there"
    assert again["digest"] == quiet["digest"]
    (run,) = out.glob("runs/*")
    assert {path.name for path in (run / "evaluation").iterdir()} <= set(OURS) - {"finished"}
    assert not list((out / "unfinished").iterdir())


def test_a_sweep_of_one_run_shares_its_episodes_among_the_workers(tmp_path, monkeypatch):
    grid = replace(BLIND, seed=(0,), demonstrations=(1,), episodes=3)
    alone = sweep(grid, tmp_path / "alone")
    asked = []
    run_of = Jobs.run

    def noted(self, run, processes=1):
        asked.append(processes)
        return run_of(self, run, processes)

    monkeypatch.setattr(Jobs, "run", noted)
    shared = sweep(grid, tmp_path / "shared", workers=4)
    assert shared["digest"] == alone["digest"] and shared["done"] == 1
    assert max(asked) == 2, "the other two do the reference"
    assert counts(sweep(grid, tmp_path / "shared")) == (1, 0, 1, 0, 0, 0), "not part of the key"


def test_a_finished_sweep_does_nothing(quiet):
    out, first = quiet
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    again = sweep(BLIND, out)
    assert (counts(again), again["digest"]) == ((4, 0, 4, 0, 0, 0), first["digest"])
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert {path.name for path in after if after[path] != before.get(path)} == {"episodes.parquet"}


def test_chosen_runs_are_done_and_the_others_left_for_later(quiet, tmp_path):
    out = tmp_path / "out"
    grid = replace(BLIND, task=("grasp", "place"))
    chosen = sweep(grid, out, only=("task=grasp", "seed=1", "demonstrations=1", "2"))
    assert counts(chosen) == (8, 2, 0, 0, 0, 6)
    assert [path.name for path in (out / "data").iterdir()] == ["grasp"], (
        "nothing is made for runs that are left"
    )
    assert [path.name for path in (out / "references").iterdir()] == ["expert-grasp"]
    again = sweep(grid, out, only=("task=grasp",))
    assert counts(again) == (8, 2, 2, 0, 0, 4) and again["digest"] == quiet[1]["digest"]


@pytest.mark.parametrize(
    ("only", "told"),
    [
        (("grasp",), "give AXIS=VALUE,VALUE; axes: task, encoder"),
        (("tsak=grasp",), "Did you mean 'task'"),
        (("seed=0", "2"), "allowed|Allowed|0, 1"),
        (("encoder=nune",), "Did you mean 'none'"),
    ],
)
def test_a_wrong_choice_names_the_right_ones(only, told):
    with pytest.raises(InputError, match=told):
        read_choice(only, BLIND.runs)


def test_a_run_made_by_something_else_is_done_again_in_its_place(quiet, tmp_path):
    out, first = quiet
    state = plan(BLIND, out)[0]
    path = out / "runs" / state.key / "result.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "job": "other"}))
    assert [(s.state, s.reason) for s in plan(BLIND, out)][:2] == [
        ("to do", "made by other code or other data"),
        ("cached", ""),
    ]
    again = sweep(BLIND, out)
    assert (counts(again), again["digest"]) == ((4, 1, 3, 0, 0, 0), first["digest"])


def test_smaller_sets_of_demonstrations_lie_within_larger(quiet):
    out, _ = quiet
    dataset = open_dataset(out / "data/grasp/dataset")
    part = first_episodes(dataset, 1)
    assert 0 < part.length < dataset.length and part.fingerprint != dataset.fingerprint
    for key, values in part.columns().items():
        np.testing.assert_array_equal(values, dataset.columns()[key][: part.length])
    np.testing.assert_array_equal(part.frames("front", 0, 3), dataset.frames("front", 0, 3))
    for wrong in (0, 3):
        with pytest.raises(InputError, match="holds 2"):
            first_episodes(dataset, wrong)
    trained = {
        state.run.demonstrations: read_checkpoint(out / "runs" / state.key / "policy")
        for state in plan(BLIND, out)
        if state.run.seed == 0
    }
    assert {asked: card.frames for asked, card in trained.items()}[1] == part.length


def test_frames_of_a_stride_are_those_of_the_whole(quiet):
    out, _ = quiet
    dataset = open_dataset(out / "data/grasp/dataset")
    part = with_frame_stride(dataset, 7)
    rows = np.concatenate([np.arange(first, stop, 7) for first, stop in dataset.bounds()])
    np.testing.assert_array_equal(part.rows, rows)
    for key, values in dataset.columns().items():
        np.testing.assert_array_equal(part.columns()[key], values[rows])
    whole = dataset.frames("front")
    np.testing.assert_array_equal(part.frames("front"), whole[rows])
    np.testing.assert_array_equal(part.frames("front", 2, 5), whole[rows[2:5]])
    assert part.frames("front", 3, 3).shape == (0, 32, 32, 3)
    assert [stop - first for first, stop in part.bounds()] == np.bincount(
        part.episode_index
    ).tolist()
    assert part.fingerprint not in (dataset.fingerprint, with_frame_stride(dataset, 6).fingerprint)
    assert with_frame_stride(dataset, 1) is dataset
    assert first_episodes(part, 1).length == part.bounds()[0][1]
    with pytest.raises(InputError, match="frame_stride is 0"):
        with_frame_stride(dataset, 0)


def test_a_failing_run_is_recorded_the_rest_goes_on_and_it_is_tried_again(tmp_path):
    recipe = tmp_path / "wild.yaml"
    recipe.write_text("learning_rate: 1.0e+38\nepochs: 3\n")
    grid = replace(
        BLIND, seed=(0,), demonstrations=(2,), recipe=("paper", str(recipe)), epochs=None
    )
    grid = replace(grid, expert=False)
    result = sweep(grid, tmp_path / "out", workers=1)
    assert counts(result) == (2, 1, 0, 1, 0, 0)
    (failure,) = (tmp_path / "out").glob("runs/*/failed.json")
    error = json.loads(failure.read_text())["error"]
    assert "without overflow" in error and "Traceback" in error
    assert "failed: grasp, proprioception-wild" in result["problems"][0]
    assert pq.read_table(tmp_path / "out/episodes.parquet").num_rows == 1
    recipe.write_text("epochs: 1\n")
    assert counts(sweep(grid, tmp_path / "out")) == (2, 1, 1, 0, 0, 0)
    assert not failure.exists()


def test_a_run_that_fails_when_it_is_done_again_counts_no_longer(quiet, tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("epochs: 1\n")
    out = tmp_path / "out"
    shutil.copytree(quiet[0] / "data", out / "data")
    grid = replace(BLIND, seed=(0,), recipe=("paper", str(recipe)), epochs=None, expert=False)
    grid = replace(grid, demonstrations=(2,))
    store_table(grid, out)
    assert counts(sweep(grid, out)) == (2, 2, 0, 0, 0, 0)
    key = next(state.key for state in plan(grid, out) if state.run.recipe == str(recipe))
    path = out / "runs" / key / "result.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "job": "other"}))
    recipe.write_text("learning_rate: 1.0e+38\nepochs: 3\n")
    assert counts(sweep(grid, out)) == (2, 0, 1, 1, 0, 0)
    left = {each.name for each in path.parent.iterdir()}
    assert "failed.json" in left and not left & {"result.json", "evaluation"}
    assert pq.read_table(out / "episodes.parquet").num_rows == 1
    assert [missing.state for missing in collect(out).missing] == ["failed"]


def test_a_refused_call_changes_nothing(tmp_path):
    out = tmp_path / "out"
    store_table(replace(GROWING, seed=(0,)), out)
    before = (out / "sweep.json").read_bytes()
    (out / "work").mkdir()
    with (
        files.locked(out / "work" / LOCK),
        pytest.raises(InputError, match="Another run is working"),
    ):
        sweep(GROWING, out)
    assert (out / "sweep.json").read_bytes() == before


def test_what_fails_beside_the_runs_is_counted_and_ends_the_command_with_1(
    quiet, tmp_path, monkeypatch, capsys
):
    def broken(*arguments, **options):
        raise InputError("no expert")

    out = tmp_path / "out"
    shutil.copytree(quiet[0], out)
    shutil.rmtree(out / "references")
    monkeypatch.setattr("surgicai_vision.experiments.sweep.jobs.open_policy", broken)
    result = sweep(BLIND, out)
    assert (result["failed"], result["failed_beside"]) == (0, 1)
    monkeypatch.setattr("surgicai_vision.experiments.sweep.driver.run_sweep", lambda *_: result)
    assert main(["sweep", "smoke"]) == 1
    assert "failed: expert-grasp: no expert" in capsys.readouterr().out


def test_hierarchical_runs_share_their_policies():
    grid = Grid(
        ("suture",),
        ("random",),
        (("front",),),
        hierarchical=("privileged", "learned"),
        expert_swap=True,
    )
    runs = [run for run in grid.runs if run.is_hierarchical]
    assert len(grid.runs) == 13 and len(runs) == 12, (
        "one policy for the whole, and two hierarchical ones with five swaps each"
    )
    assert set(parts_of(runs[0])) == {"hlp", *names.SUBTASKS}
    swapped = next(run for run in runs if run.expert_swap == "place")
    assert set(parts_of(swapped)) == {"hlp", *names.SUBTASKS} - {"place"}
    assert len({part for run in runs for part in parts_of(run).values()}) == 6
    with pytest.raises(InputError, match="no depth views"):
        RunConfig(TaskConfig("suture"), "random", ("front_depth",), termination="learned")


def test_a_grid_gives_the_high_level_policy_a_recipe_of_its_kind():
    shipped = Grid(
        ("suture",),
        ("random",),
        (("front",),),
        recipe=tuple(filter(_is_of_bc, policies.recipe_names())),
        hierarchical=("learned",),
    )
    assert {"best", "endoscope", "paper"} <= {run.recipe for run in shipped.runs}
    for run in shipped.runs:
        if not run.is_hierarchical or run.recipe == "high-level":
            continue
        parts = parts_of(run)
        assert {part.recipe for name, part in parts.items() if name != "hlp"} == {run.recipe}
        high = policies.recipe_of(parts["hlp"])
        assert not high.clock, "it would be ignored: a high-level policy is fed none"
        assert high.progress or run.recipe == "paper"


def _is_of_bc(recipe):
    try:
        policies.load_recipe("bc", recipe)
    except UnknownName:  # a key that only LeRobot's policies have
        return False
    return True


def test_a_policy_that_does_not_act_is_refused_before_any_work(tmp_path):
    grid = Grid(("suture",), ("random",), (("front",),), policy=("hlp",))
    with pytest.raises(InputError, match="write `hierarchical:`"):
        sweep(grid, tmp_path / "out")
    grid = Grid(("grasp",), ("random",), (("front",),), policy=("actor",))
    with pytest.raises(InputError, match="'actor' is what an algorithm trains; write `algo:`"):
        sweep(grid, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="needs task: suture"):
        Grid(("grasp",), ("random",), (("front",),), hierarchical=("learned",))


def test_features_are_made_once_for_all_runs(tmp_path):
    grid = Grid(
        ("grasp",),
        ("random",),
        (("front",), ("front", "back")),
        seed=(0, 1),
        recipe=("paper", "best"),
    )
    jobs = Jobs(grid, tmp_path)
    seen = {job.key() for run in grid.runs for job in jobs.features(run)}
    assert len(grid.runs) == 8
    assert len(seen) == 4, "two views, all frames and every fifth"


def test_depth_is_seen_as_grey():
    depth = np.array([0.0, DEPTH_NEAR, 0.12 + 1e-5, DEPTH_FAR, 9.0], np.float32)[:, None]
    np.testing.assert_array_equal(
        grey(depth), np.repeat(np.array([[0], [0], [128], [255], [255]], np.uint8), 3, 1)
    )
    grid = Grid(("grasp",), ("random",), (("front",), ("back_depth",)))
    assert (grid.cameras, grid.has_depth) == (("front", "back"), True)


def test_lerobot_trains_on_what_the_run_says(quiet):
    dataset = open_dataset(quiet[0] / "data/grasp/dataset")
    run = RunConfig(TaskConfig("grasp"), OWN, ("front",), seed=7, policy="act", demonstrations=1)
    given = _arguments(run, dataset, dataset.path, quiet[0] / "policy")
    assert {
        "--policy.type=act",
        "--seed=7",
        "--dataset.episodes=[0]",
        '--env.cameras=["front"]',
    } <= set(given)
    inputs = next(text for text in given if text.startswith("--policy.input_features="))
    assert set(json.loads(inputs.partition("=")[2])) == {names.image_key("front"), names.STATE}


def test_a_grid_is_read_with_single_values(tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text(
        "task: grasp\nencoder: random\nview: ['front,back']\nseed: 3\ndemonstrations: [5, 10]\n"
    )
    grid = read_grid(path)
    assert [(run.seed, run.demonstrations, run.views) for run in grid.runs] == [
        (3, 5, ("front", "back")),
        (3, 10, ("front", "back")),
    ]
    assert grid.recorded == 10
    for line, error in (
        ("policy: act2", UnknownName),
        ("hierarchical: [sometimes]", UnknownName),
        ("steps: 0", InputError),
        ("source: dmp", UnknownName),
        ("noise: 2", InputError),
        ("post_success_steps: -1", InputError),
        ("seed: [-1]", InputError),
        (f"seed: [{10**400}]", InputError),
        (f"size: {10**400}", InputError),
        ("view: [[front, front]]", InputError),
    ):
        view = "" if "view:" in line else "view: [front]\n"
        path.write_text(f"task: grasp\nencoder: random\n{view}{line}\n")
        with pytest.raises(error):
            read_grid(path)


@pytest.mark.parametrize(
    ("text", "views"),
    [("front", [["front"]]), ("front,back", [["front", "back"]]), ("[front, back]", None)],
)
def test_a_single_set_of_views_stands_without_brackets(text, views, tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text(f"task: grasp\nencoder: random\nview: {text}\n")
    assert [list(view) for view in read_grid(path).view] == (views or [["front"], ["back"]])


def test_a_grid_says_who_demonstrates_and_how_much_disturbed(tmp_path):
    grid = replace(
        BLIND,
        seed=(0,),
        demonstrations=(2,),
        demonstrator="search",
        noise=0.5,
        post_success_steps=3,
    )
    assert sweep(grid, tmp_path)["done"] == 1
    made = json.loads((tmp_path / "data/grasp/demos/demos.json").read_text())["request"]
    assert made["demonstrator"] == "search" and (made["noise"], made["post_success_steps"]) == (
        0.5,
        3,
    )
    assert {run_key(run) for run in grid.runs}.isdisjoint(run_key(run) for run in BLIND.runs)


def test_the_estimate_is_by_what_finished_runs_took(quiet, tmp_path):
    out, _ = quiet
    assert estimate(plan(BLIND, out), out, 1) == 0
    assert estimate(plan(BLIND, tmp_path), tmp_path, 1) is None
    done, *left = plan(BLIND, out)
    to_do = [done, *(replace(state, state="to do", key=done.key) for state in left)]
    taken = json.loads((out / "runs" / done.key / "result.json").read_text())["seconds"]
    assert estimate(to_do, out, 2) == pytest.approx(3 * sum(taken.values()) / 2)


@pytest.mark.parametrize("size", [7, 2000])
def test_a_size_that_is_not_rendered_is_refused_when_it_is_planned(size, tmp_path):
    with pytest.raises(InputError, match=f"size is {size}"):
        plan(replace(BLIND, size=size), tmp_path)


def test_a_sweep_that_was_killed_at_its_first_write_is_begun_again(tmp_path):
    (tmp_path / f"{files.TEMPORARY}0-{GRID_FILE}").write_text("{")
    driver._open(BLIND, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [GRID_FILE]


def test_a_misspelt_recipe_is_refused_before_any_work(tmp_path):
    grid = replace(BLIND, recipe=("pepar",))
    with pytest.raises(UnknownName, match="Did you mean 'paper'"):
        sweep(grid, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_is_stored_whole_wherever_its_results_are(quiet):
    out, _ = quiet
    for state in plan(BLIND, out):
        folder = out / "runs" / state.key
        trained = read_checkpoint(folder / "policy").run
        evaluated = read_evaluation(folder / "evaluation").run
        assert evaluated == state.run and evaluated.starts == Starts(names.TEST_SEED, 1)
        assert condition_of(trained) == condition_of(evaluated), "one policy forms one condition"
        assert trained.seed == evaluated.seed
    assert read_experiment_of(out) == BLIND


def test_a_sweep_of_another_version_is_refused(tmp_path):
    (tmp_path / "sweep.json").write_text(json.dumps({"task": ["grasp"], "chain": []}))
    with pytest.raises(BadFile, match="of another version"):
        sweep(BLIND, tmp_path)


def loaded_parts(modules, depth):
    """Return the names, `depth` levels below the package, of all modules that importing loads."""
    code = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    ours = (name.split(".") for name in said.split() if name.startswith("surgicai_vision."))
    return [parts[1 : depth + 1] for parts in ours if len(parts) > depth]


def test_keys_count_every_module_that_can_change_a_run():
    """What a worker imports for a run is part of its key, or named here as harmless."""
    modules = ("surgicai_vision.experiments.sweep.jobs", "surgicai_vision.demos.record")
    loaded = {package for (package,) in loaded_parts(modules, 1)}
    counted = set(JOBS["sweep-run"].stages)
    harmless = {"core", "report", "rl"}  # rl: names and settings of algorithms
    assert loaded - counted - harmless == set()


def test_keys_count_every_module_of_core_that_can_change_a_run():
    modules = (
        "surgicai_vision.experiments.sweep.rl_jobs",
        "surgicai_vision.demos.record",
        "surgicai_vision.dataset.render_jobs",
        "surgicai_vision.experiments.sweep.jobs",
    )
    loaded = {module for package, module in loaded_parts(modules, 2) if package == "core"}
    harmless = {"errors", "executor", "files", "lazy", "plugins", "processes", "progress"}
    harmless |= {"banks", "untrusted", "yaml_text"}  # their results are in the arguments of a job
    harmless |= {"words"}  # messages only
    assert loaded - {path.stem for path in files.SHARED} - harmless == set()
    assert all(path.is_file() for path in files.SHARED)
