"""PPO over low-level policies: its env is the hierarchical policy's, its checkpoint is an HLP."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.evaluation.agent import Agent, frame_of
from surgicai_vision.evaluation.agents import BASELINES
from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig
from surgicai_vision.evaluation.policy_spec import hierarchical_policy
from surgicai_vision.evaluation.rollout import run_share
from surgicai_vision.rl import high_level
from surgicai_vision.rl.high_level import DecisionEnv, train_high_level
from surgicai_vision.rl.high_level_config import HighLevelRequest, HighLevelSettings
from surgicai_vision.training.policies import load_policy

EXPERTS = HierarchicalConfig(
    hlp="order", **dict.fromkeys(names.SUBTASKS, "expert"), termination="privileged"
)


def test_decisions_in_order_are_the_hierarchical_policy_that_takes_them_in_order():
    spec = hierarchical_policy(EXPERTS)
    env = DecisionEnv(EXPERTS, spec.config, [BASELINES["expert"]() for _ in names.SUBTASKS])
    seen, _ = env.reset(seed=4)
    start = int(np.random.default_rng(4).integers(names.VALIDATION_SEED))
    assert env.observation_space.contains(seen)
    for subtask in range(len(names.SUBTASKS)):
        assert env.phase == subtask
        seen, reward, terminated, truncated, info = env.step(np.int64(subtask))
        assert reward == 1 and not truncated and env.observation_space.contains(seen)
        assert info["progress"] == subtask + 1
    assert terminated and info["is_success"]
    steps = env.control_steps
    env.close()
    (episode,) = run_share(spec.make_agent, spec.config, [start], 1, report=lambda _: None)
    assert episode.row.success and episode.row.steps == steps


@pytest.mark.parametrize("subtask", range(len(names.SUBTASKS)))
def test_a_decision_that_solves_nothing_earns_nothing_and_ends_the_episode(subtask):
    short = dataclasses.replace(EXPERTS, steps=5)
    task = TaskConfig(names.SUTURE, max_steps=2000)
    env = DecisionEnv(short, task, [BASELINES["zero"]() for _ in names.SUBTASKS])
    env.reset(seed=0)
    _, reward, terminated, truncated, info = env.step(np.int64(subtask))
    assert (reward, terminated, truncated) == (0, True, False)
    assert not info["is_success"] and env.control_steps == 5
    env.close()


def test_an_episode_has_so_many_decisions():
    env = DecisionEnv(
        dataclasses.replace(EXPERTS, decisions=2),
        TaskConfig(names.SUTURE, max_steps=2000),
        [BASELINES["expert"]() for _ in names.SUBTASKS],
    )
    env.reset(seed=4)
    ends = [env.step(np.int64(subtask))[2:4] for subtask in (0, 1)]
    assert ends == [(False, False), (False, True)]
    env.close()


class Looking(Agent):
    """Holds still and looks at its own camera."""

    def __init__(self, camera, image_size=16, action_mode=names.INCREMENTS):
        self.cameras, self.image_size, self.action_mode = (camera,), image_size, action_mode

    def reset(self, slot, robot, seed):
        pass

    def act(self, slots, robots, observations):
        assert frame_of(observations[0], self.cameras[0]).shape == (16, 16, 3)
        return np.zeros((1, 7), np.float32)


def test_every_low_level_policy_sees_its_own_camera():
    short = dataclasses.replace(EXPERTS, steps=2)
    task = TaskConfig(names.SUTURE, max_steps=2000)
    zero = BASELINES["zero"]
    env = DecisionEnv(short, task, [zero(), Looking("front"), Looking("back_psm1"), zero(), zero()])
    env.reset(seed=0)
    for subtask in range(3):
        env.step(np.int64(subtask))
    assert env.control_steps == 6
    env.close()
    for other, said in (
        (Looking("back", image_size=32), "one image size"),
        (Looking("back", action_mode="absolute"), "set-points of both arms"),
    ):
        with pytest.raises(InputError, match=said):
            DecisionEnv(short, task, [zero(), Looking("front"), other, zero(), zero()])


def request_of(**changes):
    low = HierarchicalConfig(
        hlp="order", **dict.fromkeys(names.SUBTASKS, "zero"), termination="privileged", steps=4,
        decisions=6, max_steps=60,
    )  # fmt: skip
    settings = HighLevelSettings(hidden=(8,), rollout=8, batch_size=8, epochs=2)
    return HighLevelRequest(low, 16, settings, validation=0, save_every=8, **changes)


def test_the_checkpoint_names_what_ppo_names(tmp_path, monkeypatch):
    models = []
    original = high_level._policy

    def policy_of(request, model):
        models.append(model)
        return original(request, model)

    monkeypatch.setattr(high_level, "_policy", policy_of)
    checkpoint = train_high_level(request_of(), tmp_path / "hlp")
    assert checkpoint.run.name == "ppo-proprioception" and checkpoint.run.task == names.SUTURE
    policy = load_policy(tmp_path / "hlp")
    poses = np.random.default_rng(0).normal(size=(20, 14)).astype(np.float32) / 10
    theirs, _ = models[-1].predict(poses, deterministic=True)
    assert np.array_equal(policy.act(None, poses).argmax(axis=1), theirs)
    whole = dataclasses.replace(request_of().low, hlp=str(tmp_path / "hlp"))
    assert hierarchical_policy(whole).config.task == names.SUTURE
    with pytest.raises(OutputExists):
        train_high_level(request_of(seed=1), tmp_path / "hlp")


def test_the_policy_of_the_best_evaluation_is_kept(tmp_path, monkeypatch):
    shorter = dataclasses.replace(request_of(), decisions=8)
    early = train_high_level(shorter, tmp_path / "early")
    original = high_level._evaluate

    def evaluate(*arguments):
        point = original(*arguments)
        return dataclasses.replace(point, successes=16 - point.decisions)

    monkeypatch.setattr(high_level, "_evaluate", evaluate)
    kept = train_high_level(request_of(), tmp_path / "kept")
    assert kept.policy_sha256 == early.policy_sha256 and kept.frames == 8
    killed = high_level._save

    def die(*arguments):
        killed(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(high_level, "_save", die)
    with pytest.raises(KeyboardInterrupt):
        train_high_level(request_of(), tmp_path / "killed")
    monkeypatch.setattr(high_level, "_save", killed)
    resumed = train_high_level(request_of(), tmp_path / "killed")
    assert resumed.policy_sha256 == kept.policy_sha256


def test_a_kill_changes_no_result(tmp_path, temporary, monkeypatch):
    whole = train_high_level(request_of(), tmp_path / "whole")
    assert not list(temporary.iterdir())
    original = high_level._save

    def die(*arguments):
        original(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(high_level, "_save", die)
    with pytest.raises(KeyboardInterrupt):
        train_high_level(request_of(), tmp_path / "killed")
    monkeypatch.setattr(high_level, "_save", original)
    resumed = train_high_level(request_of(), tmp_path / "killed")
    assert resumed.policy_sha256 == whole.policy_sha256


def test_a_validation_counts_the_control_steps_of_held_actions(monkeypatch):
    made = []

    def run(make, task, seeds, at_once, report):
        made.append(make())
        return [SimpleNamespace(row=SimpleNamespace(success=False, stages=0))]

    monkeypatch.setattr(high_level, "run_share", run)
    request = dataclasses.replace(request_of(), validation=1)
    held = TaskConfig(names.SUTURE, action_repeat=4)
    low = [BASELINES["zero"]] * len(names.SUBTASKS)
    played = SimpleNamespace(control_steps=0)
    high_level._evaluate(request, held, low, SimpleNamespace(), 8, played, 0.0)
    assert [agent._action_repeat for agent in made] == [4]


def test_images_of_several_sizes_are_refused_before_the_folder_is_begun(tmp_path, monkeypatch):
    sizes = iter((16, 32, 16, 16, 16))

    def opened(path, **options):
        size = next(sizes)
        return SimpleNamespace(name=path, about={}, make_agent=lambda: Looking("front", size))

    monkeypatch.setattr(high_level, "open_policy", opened)
    with pytest.raises(InputError, match=r"\[16, 32\] pixels"):
        train_high_level(request_of(), tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"rollout": 1}, "rollout is 1; it must be at least 2"),
        ({"batch_size": 1}, "batch_size is 1; it must be at least 2"),
        ({"entropy": float("nan")}, "entropy is nan"),
        ({"learning_rate": float("inf")}, "learning_rate is inf"),
    ],
)
def test_settings_that_ppo_cannot_learn_with_are_refused(change, told):
    with pytest.raises(InputError, match=told):
        HighLevelSettings(**change)


def test_a_learned_termination_is_refused():
    learned = dataclasses.replace(EXPERTS, hlp="outputs/train/hlp", termination="learned")
    with pytest.raises(InputError, match="hlp: order"):
        HighLevelRequest(learned)
