"""Training: every algorithm leaves a checkpoint that every verb takes; a kill changes no result."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from policies.actor import VECTORS, ActorRecipe
from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, OutputExists, UnknownName
from surgicai_vision.core.files import TEMPORARY
from surgicai_vision.demos.store import (
    demos_digest,
    list_demos,
    read_demo,
    write_demo,
    write_marker,
)
from surgicai_vision.evaluation.hierarchical_config import MAX_STEPS
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.rl import train as training
from surgicai_vision.rl.algorithms import ALGORITHMS
from surgicai_vision.rl.settings import Request, Settings, settings_of
from surgicai_vision.rl.train import train
from surgicai_vision.rl.transitions import of_demos
from surgicai_vision.training.folder import STATE
from surgicai_vision.training.policies import load_policy

SMALL = {"hidden": [16, 16], "batch_size": 16}
LIMIT = 8


def request_of(algo, demos, task="grasp", **changes):
    algorithm = ALGORITHMS[algo]
    paths = list_demos(demos[task]) if algorithm.needs_demos else []
    small = SMALL | ({"rollout": 24} if algo == "ppo" else {})
    steps, save_every = 48, 24
    if "learning_starts" in algorithm.settings:
        small["learning_starts"] = LIMIT + 2
    if algorithm.needs_demos and algorithm.has_hindsight:
        # an episode must end before hindsight looks back at it
        small["learning_starts"], steps, save_every = 205, 212, 206
    # Demonstrations are longer than `LIMIT` allows, so their env keeps its own limit.
    env = TaskConfig(task) if algorithm.needs_demos else TaskConfig(task, max_steps=LIMIT)
    request = Request(
        algo=algo,
        env=env,
        settings=settings_of(algo, small),
        env_steps=steps if algorithm.is_online else 0,
        updates=0 if algorithm.is_online else 12,
        demonstrations=len(paths),
        demos=demos_digest(paths) if paths else "",
        validation=0,
        save_every=save_every if algorithm.is_online else 6,
    )
    return replace(request, **changes), paths


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_leaves_a_policy_that_acts_as_the_librarys(algo, demos, tmp_path):
    request, paths = request_of(algo, demos)
    kept = []
    original = training._evaluate

    def evaluate(asked, actor, learner, minutes):
        kept.append(library_actions(learner, seen))
        return original(asked, actor, learner, minutes)

    env = envs.make(request.env, "goal")
    shown = envs.make(request.env, "relative")
    env.reset(seed=3)
    shown.reset(seed=3)
    moves = np.random.default_rng(0).uniform(-1, 1, (5, 7)).astype(np.float32)
    seen = [(env.step(move)[0], shown.step(move)[0]) for move in moves]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "_evaluate", evaluate)
        checkpoint = train(request, paths, tmp_path / "out", tensorboard=False)
    policy = load_policy(tmp_path / "out")
    assert policy.inputs.vector == (VECTORS["relative"],)
    ours = policy.act(None, np.stack([relative for _, relative in seen]))
    assert np.abs(ours).max() <= 1
    assert np.allclose(ours, kept[-1], atol=2e-5)
    assert checkpoint.run.algo == algo and checkpoint.run.name == f"{algo}-relative"
    assert set(checkpoint.recipe["settings"]) == set(ALGORITHMS[algo].settings)
    spec = open_policy(tmp_path / "out")
    assert spec.run == checkpoint.run and spec.config == request.env
    assert not (tmp_path / "out" / STATE).exists()


def library_actions(learner, seen):
    """The greedy actions of the library's own model."""
    relative = np.stack([row for _, row in seen])
    if hasattr(learner, "model"):
        has_goal = learner.request.algorithm.has_hindsight
        goals = {key: np.stack([row[key] for row, _ in seen]) for key in seen[0][0]}
        return learner.model.predict(goals if has_goal else relative, deterministic=True)[0]
    standard = ((relative - learner.mean.numpy()) / learner.std.numpy()).astype(np.float32)
    if learner.request.algo != "bcq":
        return learner.greedy(standard)
    # The library draws anew each time, so its networks get the stored draws.
    modules = learner._algo.impl.modules
    draws = training.actor_of(learner.request, learner).draws
    chosen = []
    with torch.no_grad():
        for row in torch.from_numpy(standard):
            rows = row.expand(len(draws), -1)
            actions = modules.policy(rows, modules.vae_decoder(rows, draws)).squashed_mu
            chosen.append(actions[modules.q_funcs[0](rows, actions).q_value.argmax()])
    return torch.stack(chosen).numpy()


class Killed(BaseException):
    """Ends a training in the middle."""


@pytest.mark.parametrize("algo", ["td3-her-bc", "rlpd", "ppo", "td3-her", "iql", "tqc"])
def test_a_killed_training_ends_as_if_it_had_not_been_killed(algo, demos, tmp_path):
    request, paths = request_of(algo, demos)
    if algo == "td3-her-bc":
        request = replace(request, env_steps=224, save_every=216)  # in the middle of an episode
    whole = train(request, paths, tmp_path / "whole", tensorboard=False)

    def kill(done, total, unit=""):
        if 0 < done < total:
            with pytest.raises(InputError, match="Another run is training"):
                train(request, paths, tmp_path / "killed", tensorboard=False)
            raise Killed

    with pytest.raises(Killed):
        train(request, paths, tmp_path / "killed", progress=kill, tensorboard=False)
    assert (tmp_path / "killed" / STATE).exists()
    (tmp_path / "killed" / f"{TEMPORARY}0-{STATE}").write_bytes(b"torn")
    started = []
    resumed = train(
        request,
        paths,
        tmp_path / "killed",
        progress=lambda done, *_: started.append(done),
        tensorboard=False,
    )
    assert 0 < started[0] < request.total  # it continued
    assert resumed.policy_sha256 == whole.policy_sha256
    assert not list((tmp_path / "killed").glob(f"{TEMPORARY}*"))


@pytest.mark.parametrize("killed_at", [None, 36])
def test_the_policy_kept_is_that_of_the_most_successes(killed_at, tmp_path, monkeypatch):
    request = replace(request_of("td3", {})[0], save_every=12)
    successes = {12: 1, 24: 3, 36: 3, 48: 2}
    seen = {}

    def evaluate(asked, actor, learner, minutes):
        seen[learner.done] = {name: value.clone() for name, value in actor.state_dict().items()}
        count = successes[learner.done]
        return training.Point(learner.done, learner.updates, minutes, count, 5, 1.0)

    def kill(done, total, unit=""):
        if done == killed_at:
            raise Killed

    monkeypatch.setattr(training, "_evaluate", evaluate)
    if killed_at:
        with pytest.raises(Killed):
            train(request, [], tmp_path / "out", progress=kill, tensorboard=False)
    checkpoint = train(request, [], tmp_path / "out", tensorboard=False)
    assert sorted(seen) == sorted(successes) and checkpoint.frames == 36
    kept = load_policy(tmp_path / "out").state_dict()
    assert all(torch.equal(kept[name], value) for name, value in seen[36].items())
    assert not all(torch.equal(kept[name], value) for name, value in seen[48].items())


@pytest.mark.parametrize("killed_at", [None, 24])
def test_learning_ends_once_it_is_solved_twice_in_a_row(killed_at, tmp_path, monkeypatch):
    request, _ = request_of("td3", {}, save_every=12, validation=5)
    request = replace(request, settings=replace(request.settings, stop_at=0.6))
    successes = {12: 3, 24: 2, 36: 3, 48: 4}
    shown = []

    def evaluate(asked, actor, learner, minutes):
        count = successes.get(learner.done, 5)
        return training.Point(learner.done, learner.updates, minutes, count, 5, 1.0)

    def show(done, total, unit=""):
        shown.append((done, total))
        if done == killed_at and killed_at not in shown:
            shown.append(killed_at)
            raise Killed

    monkeypatch.setattr(training, "_evaluate", evaluate)
    request = replace(request, env_steps=96)
    if killed_at:
        with pytest.raises(Killed):
            train(request, [], tmp_path / "out", progress=show, tensorboard=False)
    checkpoint = train(request, [], tmp_path / "out", progress=show, tensorboard=False)
    assert checkpoint.frames == 48 and shown[-1] == (96, 96)
    assert len(json.loads((tmp_path / "out" / training.CURVE).read_text())) == 4
    with pytest.raises(InputError, match="validation of at least 1"):
        replace(request, validation=0)


@pytest.mark.parametrize("algo", ["td3", "ppo", "bc"])
def test_nothing_is_left_in_the_temporary_folder(algo, demos, tmp_path, temporary):
    request, paths = request_of(algo, demos)
    train(request, paths, tmp_path / "out", tensorboard=False)
    assert not list(temporary.iterdir())


def test_workers_change_no_result(demos, tmp_path):
    request, _ = request_of("td3", demos)
    settings = replace(request.settings, envs=2)
    request = replace(request, settings=settings)
    hashes = {
        train(
            request, [], tmp_path / str(workers), workers=workers, tensorboard=False
        ).policy_sha256
        for workers in (0, 1, 2)
    }
    assert len(hashes) == 1
    other = train(replace(request, seed=1), [], tmp_path / "other", tensorboard=False)
    assert other.policy_sha256 not in hashes


def test_the_verb_trains_seeds_side_by_side_and_evaluate_takes_them(
    demos, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    given = ["train", "--algo", "bc", "--demos", str(demos["grasp"]), "--updates", "4"]
    given += ["--change", "hidden=[8],batch_size=8", "--validation", "1", "--save-every", "2"]
    assert main([*given, "--seeds", "2", "--workers", "2", "--json"]) == 0
    outs = json.loads(capsys.readouterr().out.splitlines()[-1])["checkpoints"]
    assert len(outs) == 2
    for out in outs:
        curve = json.loads((tmp_path / out / training.CURVE).read_text())
        assert [point["updates"] for point in curve] == [2, 4]
        assert all(point["episodes"] == 1 for point in curve)
    assert main(["evaluate", outs[1], "--episodes", "1", "--workers", "1"]) == 0
    assert "on grasp: 0/1" in capsys.readouterr().out
    assert list(tmp_path.glob("outputs/train/*-tensorboard/events*"))


def test_an_actor_is_a_low_level_policy_of_a_hierarchical_one(demos, tmp_path):
    request, paths = request_of("bc", demos, "insert", updates=2)
    train(request, paths, tmp_path / "insert", tensorboard=False)
    low = dict.fromkeys(names.SUBTASKS, "expert") | {"insert": str(tmp_path / "insert")}
    text = yaml.safe_dump({"hlp": "order", **low, "termination": "privileged"})
    (tmp_path / "h.yaml").write_text(text)
    spec = open_policy(tmp_path / "h.yaml")
    assert spec.config == TaskConfig("suture", max_steps=MAX_STEPS)
    agent = spec.make_agent()
    assert agent.privileged and not agent.cameras
    env = envs.make(spec.config)
    observation, _ = env.reset(seed=0)
    agent.reset(0, env, 0)
    env.enter(2)
    ours = load_policy(tmp_path / "insert").act(None, env.relative_state()[None])
    assert np.array_equal(agent.act([0], [env], [observation]), ours)


def test_what_cannot_be_trained_is_refused_before_any_work(demos, tmp_path, capsys):
    def refused(*options):
        assert main(["train", "--algo", *options, "--out", str(tmp_path / "no")]) == 2
        assert not (tmp_path / "no").exists()
        return capsys.readouterr().err

    assert "bc_weight" in refused("sac", "--change", "bc_weight=0.2")
    assert "does not learn from demonstrations" in refused("sac", "--demos", str(demos["grasp"]))
    assert "give observation relative" in refused("td3-her", "--observation", "state")
    assert "imitation" in refused("sac", "--view", "front")
    assert "several" in refused("td3-her", "--task", "suture")
    assert "at least 201, or 0" in refused("td3-her", "--change", "learning_starts=200")
    assert "at least 0" in refused("td3", "--change", "learning_starts=-1")
    assert "at least 0" in refused("td3", "--change", "exploration_noise=-0.1")
    assert "finite" in refused("td3", "--change", "learning_rate=.inf")
    for algo, setting in (("ppo", "rollout"), ("ppo", "batch_size"), ("td3", "batch_size")):
        assert f"{setting} is 1; it must be at least 2" in refused(algo, "--change", f"{setting}=1")
    with pytest.raises(InputError, match="at most 65536"):
        settings_of("td3", {"hidden": [65_537]})
    with pytest.raises(InputError, match="at most 65536"):  # as a policy's recipe does
        ActorRecipe(hidden=(65_537,))
    shown = ("--demos", str(demos["grasp"]))
    for algo, share, rows in (("td3-bc", 0.001, 0), ("rlpd", 0.999, 256)):
        assert f"{rows} of the 256" in refused(algo, *shown, "--change", f"demo_share={share}")
    unread = (("bc", "tau=0.1"), ("bc", "gamma=0.9"), ("awac", "samples=4"), ("iql", "samples=4"))
    for algo, change in unread:
        assert f"setting of '{algo}'" in refused(algo, *shown, "--change", change)
    with pytest.raises(UnknownName, match="td3"):
        settings_of("td4", {})
    with pytest.raises(InputError, match="gamma is 1"):
        Settings(gamma=1.0)
    request, _ = request_of("bc", demos)
    train(request, list_demos(demos["grasp"]), tmp_path / "a", tensorboard=False)
    with pytest.raises(OutputExists, match="another training"):
        train(replace(request, seed=1), list_demos(demos["grasp"]), tmp_path / "a")


def test_a_training_that_would_end_before_its_first_update_is_refused(demos, tmp_path, capsys):
    given = ["train", "--algo", "td3", "--out", str(tmp_path / "no"), "--env-steps"]
    assert main([*given, "1000"]) == 2
    assert "the first 1000 have random actions" in capsys.readouterr().err
    request, _ = request_of("td3", demos)
    first = request.settings.learning_starts
    assert replace(request, env_steps=first + 1).random_steps == first
    with pytest.raises(InputError, match=f"the first {first} have"):
        replace(request, env_steps=first)
    held = replace(request.env, action_repeat=2)
    with pytest.raises(InputError, match=f"the first {2 * first} have"):
        replace(request, env=held, env_steps=2 * first)


@pytest.mark.parametrize("change", ["success_steps=3", "tolerance_share=0.5", "keeps_holes=true"])
def test_a_rule_that_the_whole_procedure_does_not_read_is_refused(change, tmp_path, capsys):
    given = ["train", "--algo", "ppo", "--task", "suture", "--out", str(tmp_path / "no")]
    assert main([*given, "--change", change]) == 2
    assert "are for one subtask" in capsys.readouterr().err


def test_demonstrations_that_are_refused_leave_no_folder(demos, tmp_path, capsys):
    out = tmp_path / "out"
    given = ["train", "--algo", "bc", "--demos", str(demos["grasp"]), "--out", str(out)]
    assert main([*given, "--change", "success_steps=30"]) == 2
    assert "None of 2 demonstrations" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("seeds", [1, 2])
def test_demonstrations_that_are_left_out_are_told_once(
    seeds, demos, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    first, second = (read_demo(path) for path in list_demos(demos["grasp"]))
    write_demo(tmp_path, 0, first)
    still = np.zeros_like(second.action)
    write_demo(tmp_path, 1, replace(second, action=still, executed=still))
    write_marker(tmp_path, "grasp", "expert")
    given = ["train", "--algo", "bc", "--demos", ".", "--updates", "2", "--validation", "0"]
    assert main([*given, "--seeds", str(seeds), "--workers", "2", "--log", "none"]) == 0
    told = capsys.readouterr().err
    assert told.count("1 of 2 demonstrations did not succeed when replayed") == 1


@pytest.mark.parametrize("algo", ["ppo", "sac", "td3"])
def test_a_training_that_diverges_says_so_in_one_line(algo, demos, tmp_path):
    """The library's distribution refuses the actor's mean or its deviation, or the env its NaN."""
    request, _ = request_of(algo, demos)
    settings = replace(request.settings, learning_rate=1e10)
    with pytest.raises(InputError, match=r"diverged.*lower the learning rate"):
        train(replace(request, settings=settings), [], tmp_path / "out", tensorboard=False)


def test_a_missing_extra_is_one_clear_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None)
    assert main(["train", "--algo", "sac", "--out", str(tmp_path / "no")]) == 2
    error = capsys.readouterr().err
    assert "--algo sac needs the extra 'rl'" in error and len(error.strip().splitlines()) == 1


def test_gym_is_imported_without_its_notice(tmp_path):
    code = "import surgicai_vision.rl.high_level, sys; assert 'gym' in sys.modules"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=tmp_path, capture_output=True
    )
    assert b"gym" not in done.stderr.lower()


def test_importing_the_verb_imports_no_library_of_the_extra(tmp_path):
    code = (
        "import sys, surgicai_vision.commands.train, surgicai_vision.rl.settings\n"
        "assert not {'stable_baselines3', 'd3rlpy', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


def test_whether_a_relabelled_goal_keeps_its_demand_follows_the_task():
    def keeps(task, **changes):
        settings = settings_of("td3-her", changes)
        return Request("td3-her", TaskConfig(task), settings=settings, env_steps=2000).keeps_demand

    assert [keeps(task) for task in ("grasp", "place", "insert", "handoff", "pullout")] == [
        False, False, True, False, True,
    ]  # fmt: skip
    assert keeps("grasp", relabel_demand="kept") and not keeps("insert", relabel_demand="achieved")


def test_statistics_are_finite_and_floored(demos):
    request, paths = request_of("bc", demos)
    learner = training._learner(request, of_demos(paths, request.env), 0)
    assert torch.isfinite(learner.mean).all() and (learner.std >= training.SMALLEST_STD).all()
