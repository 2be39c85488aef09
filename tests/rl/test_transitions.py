"""Demonstrations as transitions: they match the env, in every library's format."""

import os
from dataclasses import replace

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core.config import SuccessRule, TaskConfig
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.tasks import load_subtask
from surgicai_vision.demos.store import list_demos, read_demo
from surgicai_vision.envs.observation import goal_errors
from surgicai_vision.rl import export
from surgicai_vision.rl.transitions import (
    OBS_TYPES,
    OBSERVATION,
    of_demos,
    read_transitions,
    write_transitions,
)


def as_dict(observation):
    return observation if isinstance(observation, dict) else {OBSERVATION: observation}


def same(one, other):
    return all(np.array_equal(one[key], other[key]) for key in one) and set(one) == set(other)


@pytest.mark.parametrize("obs_type", OBS_TYPES)
@pytest.mark.parametrize("task", ["grasp", "insert"])
def test_a_transition_replayed_in_the_env_gives_its_reward_and_next_observation(
    demos, task, obs_type
):
    paths = list_demos(demos[task])
    found = of_demos(paths, obs_type=obs_type)
    env = envs.make(TaskConfig(task), obs_type)
    row = 0
    for index, path in enumerate(paths):
        demo = read_demo(path)
        assert not np.array_equal(demo.executed, demo.action)
        steps = int(np.argmax(demo.success)) + 1
        assert steps < len(demo)  # what was recorded after the success is left out
        for step in range(steps):
            env.set_state_vector(demo.state[step])
            assert np.array_equal(found.action[row], demo.executed[step])
            assert same(as_dict(env.observe()), {k: p[row] for k, p in found.observation.items()})
            seen, reward, terminated, truncated, _ = env.step(found.action[row])
            assert same(as_dict(seen), {k: p[row] for k, p in found.next_observation.items()})
            assert np.array_equal(env.get_state(), demo.state[step + 1])
            assert (reward, terminated) == (found.reward[row], found.terminated[row])
            assert truncated == found.truncated[row] == False  # noqa: E712
            assert found.episode[row] == index
            row += 1
        assert found.terminated[row - 1]
    assert row == len(found) and found.episodes == 2 and found.failed == 0
    assert found.seeds.tolist() == [0, 1]


def test_options_of_the_env_hold_in_the_replay(demos):
    paths = list_demos(demos["insert"])
    plain = of_demos(paths)
    held = of_demos(paths, TaskConfig("insert", hold_jaw=True, reward="staged"))
    assert (held.action[:, 6] == 0).all() and not (plain.action[:, 6] == 0).all()
    assert np.all(held.reward[held.terminated] == 0)
    assert np.all((held.reward > -1) & (held.reward <= 0))
    twice = of_demos(paths, TaskConfig("insert", action_repeat=2))
    assert len(twice) < 0.7 * len(plain)
    both = replace(TaskConfig("insert"), step="released")
    with pytest.raises(InputError, match=r"recorded with step paper.*released"):
        of_demos(paths, both)
    with pytest.raises(InputError, match="task grasp"):
        of_demos(list_demos(demos["grasp"]), TaskConfig("insert"))


@pytest.mark.parametrize("task", ["grasp", "insert"])
def test_a_success_that_must_hold_ends_a_demonstration_so_many_steps_later(demos, task):
    paths = list_demos(demos[task])
    plain = of_demos(paths)
    held = of_demos(paths, success_rule=SuccessRule(3))
    assert held.episodes == 2 and len(held) >= len(plain) + 2 * 2
    for episode in range(2):
        met = int(np.argmax(read_demo(paths[episode]).success)) + 1
        rewards = held.reward[held.episode == episode]
        assert len(rewards) >= met + 2
        assert rewards[-1] == 0 and (rewards[:-1] == -1).all()
    with pytest.raises(InputError, match="--post-success-steps"):
        of_demos(paths, success_rule=SuccessRule(9))


def test_a_share_of_the_tolerance_ends_a_demonstration_nearer_to_its_goal(demos):
    paths = list_demos(demos["insert"])
    tolerance = load_subtask("insert").tolerances["paper"]

    def used(transitions):
        last = transitions.next_observation
        distance, turn = goal_errors(last["achieved_goal"], last["desired_goal"])
        shares = np.maximum(distance / tolerance.distance, turn / tolerance.angle)
        return shares[transitions.terminated].max()

    plain = of_demos(paths, obs_type="goal")
    share = float(0.99 * used(plain))
    nearer = of_demos(paths, obs_type="goal", success_rule=SuccessRule(tolerance_share=share))
    assert nearer.episodes == plain.episodes and len(nearer) > len(plain)
    assert used(nearer) <= share < used(plain) <= 1


def test_what_is_written_is_read(demos, tmp_path):
    found = of_demos(list_demos(demos["grasp"]), obs_type="goal")
    write_transitions(tmp_path / "a.npz", found)
    again = read_transitions(tmp_path / "a.npz")
    assert again.config == found.config and again.demos == found.demos
    assert same(again.observation, found.observation)
    assert same(again.next_observation, found.next_observation)
    assert np.array_equal(again.reward, found.reward)
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(BadFile, match="not a file of transitions"):
        read_transitions(tmp_path / "a.npz")


def test_a_damaged_file_of_transitions_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, about=np.array("5"), reward=np.arange(2000.0))
    content = path.read_bytes()
    for position in range(0, len(content), 7):
        spoilt = bytearray(content)
        spoilt[position] ^= 0x5A
        path.write_bytes(spoilt)
        with pytest.raises(BadFile):
            read_transitions(path)


def run(demos, tmp_path, task, *options):
    folder = tmp_path / "out"
    given = ["export-demos", "--task", task, "--demos", str(demos[task]), "--out", str(folder)]
    assert main([*given, *options]) == 0
    return folder


def test_stable_baselines_reads_a_replay_buffer(demos, tmp_path):
    from stable_baselines3 import TD3

    folder = run(demos, tmp_path, "grasp", "--format", "sb3", "--obs-type", "state")
    found = of_demos(list_demos(demos["grasp"]), obs_type="state")
    model = TD3("MlpPolicy", envs.make(TaskConfig("grasp")), buffer_size=10)
    model.load_replay_buffer(folder / "buffer.pkl")
    buffer = model.replay_buffer
    assert buffer.full and buffer.buffer_size == len(found)
    assert np.array_equal(buffer.observations[:, 0], found.vector)
    assert np.array_equal(buffer.next_observations[:, 0], found.next_vector)
    assert np.array_equal(buffer.rewards[:, 0], found.reward)
    assert np.array_equal(buffer.dones[:, 0], found.terminated)
    assert len(model.replay_buffer.sample(32).rewards) == 32


def test_a_buffer_that_would_lose_transitions_is_refused(demos):
    found = of_demos(list_demos(demos["grasp"]), obs_type="state")
    space = export.space_of(found)
    export.fill(ReplayBuffer(len(found), space, export.ACTIONS, device="cpu"), found)
    smaller = ReplayBuffer(len(found) - 1, space, export.ACTIONS, device="cpu")
    with pytest.raises(InputError, match=f"holds {len(found) - 1} transitions"):
        export.fill(smaller, found)
    assert not smaller.pos


def test_stable_baselines_relabels_demonstrations(demos, tmp_path):
    from stable_baselines3 import SAC, HerReplayBuffer

    folder = run(demos, tmp_path, "insert", "--format", "sb3", "--obs-type", "goal")
    env = envs.make(TaskConfig("insert"), "goal")
    model = SAC(
        "MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=0, seed=0
    )
    model.load_replay_buffer(folder / "buffer.pkl")
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    batch = model.replay_buffer.sample(64)
    rewards = env.compute_reward(
        batch.next_observations["achieved_goal"].numpy(),
        batch.next_observations["desired_goal"].numpy(),
    )
    assert np.array_equal(rewards, batch.rewards.numpy()[:, 0]) and (rewards == 0).sum() > 3


def test_d3rlpy_reads_a_dataset(demos, tmp_path):
    from d3rlpy.dataset import InfiniteBuffer, ReplayBuffer

    folder = run(demos, tmp_path, "grasp", "--format", "d3rlpy")
    found = of_demos(list_demos(demos["grasp"]))
    with open(folder / "dataset.h5", "rb") as file:
        dataset = ReplayBuffer.load(file, InfiniteBuffer())
    assert [episode.transition_count for episode in dataset.episodes] == [
        int((found.episode == index).sum()) for index in range(2)
    ]
    assert all(episode.terminated for episode in dataset.episodes)
    rows = np.concatenate([episode.observations for episode in dataset.episodes])
    assert np.array_equal(rows, found.vector)
    assert np.array_equal(
        np.concatenate([episode.rewards for episode in dataset.episodes])[:, 0], found.reward
    )
    first = dataset.transition_picker(dataset.episodes[0], 3)
    assert np.array_equal(first.next_observation, found.next_vector[3])


@pytest.mark.parametrize("obs_type", ["goal", "relative"])
def test_minari_reads_a_dataset(demos, tmp_path, monkeypatch, obs_type):
    monkeypatch.setitem(os.environ, "MINARI_DATASETS_PATH", "")
    folder = run(demos, tmp_path, "grasp", "--format", "minari", "--obs-type", obs_type)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    import minari

    dataset = minari.load_dataset(f"surgicai/grasp/{obs_type}-v0")
    found = of_demos(list_demos(demos["grasp"]), obs_type=obs_type)
    assert dataset.total_steps == len(found)
    row = 0
    for episode in dataset.iterate_episodes():
        seen = as_dict(episode.observations)
        for step in range(len(episode.rewards)):
            assert same(
                {k: p[step] for k, p in seen.items()},
                {k: p[row] for k, p in found.observation.items()},
            )
            assert same(
                {k: p[step + 1] for k, p in seen.items()},
                {k: p[row] for k, p in found.next_observation.items()},
            )
            assert episode.rewards[step] == found.reward[row]
            row += 1
        assert episode.terminations[-1]
    assert row == len(found)


def test_what_a_library_does_not_take_is_refused(demos, tmp_path, capsys):
    given = ["export-demos", "--demos", str(demos["grasp"]), "--out", str(tmp_path / "o")]
    assert main([*given, "--format", "d3rlpy", "--obs-type", "goal"]) == 2
    assert "relative or state" in capsys.readouterr().err


def test_a_missing_extra_is_one_clear_line(demos, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None)
    given = ["export-demos", "--demos", str(demos["grasp"]), "--out", str(tmp_path / "o")]
    assert main([*given, "--format", "minari"]) == 2
    error = capsys.readouterr().err
    assert "pip install 'surgicai-vision[rl]'" in error and len(error.strip().splitlines()) == 1
    assert export.FORMATS.keys() == export.PACKAGES.keys()
