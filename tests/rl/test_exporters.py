"""Exports that know their env: Minari recovers it, and robomimic reads every transition."""

import dataclasses
import json
import os
from pathlib import Path

import gymnasium
import h5py
import numpy as np
import pytest

from surgicai_vision.commands.main import main
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.store import list_demos
from surgicai_vision.rl import export
from surgicai_vision.rl.transitions import OBSERVATION, Transitions, of_demos


def as_dict(observation):
    return observation if isinstance(observation, dict) else {OBSERVATION: observation}


def assert_same(one, other):
    assert one.keys() == other.keys()
    for key, values in one.items():
        np.testing.assert_array_equal(values, other[key])


@pytest.mark.parametrize("obs_type", ["goal", "state"])
def test_minari_recovers_the_env_and_its_episodes(demos, tmp_path, monkeypatch, obs_type):
    """From its seed, the recovered env reproduces each episode's observations and rewards."""
    monkeypatch.setitem(os.environ, "MINARI_DATASETS_PATH", "")
    config = TaskConfig("grasp", reward="dense", max_steps=300)
    found = of_demos(list_demos(demos["grasp"]), config, obs_type)
    folder = export.write(found, "minari", tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    import minari

    dataset = minari.load_dataset(f"surgicai/grasp/{obs_type}-v0")
    env = dataset.recover_environment()
    assert env.unwrapped.config.reward == "dense"
    assert env.spec.max_episode_steps == 300
    held = dataclasses.replace(config, action_repeat=2)  # gymnasium counts actions
    spec = export.spec_of(dataclasses.replace(found, config=held))
    assert spec.max_episode_steps == 150
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    for number, episode in enumerate(dataset.iterate_episodes()):
        seen, _ = env.reset(seed=int(found.seeds[number]))
        stored = as_dict(episode.observations)
        assert_same(as_dict(seen), {key: part[0] for key, part in stored.items()})
        for step, action in enumerate(episode.actions):
            seen, reward, terminated, _, _ = env.step(action)
            assert_same(as_dict(seen), {key: part[step + 1] for key, part in stored.items()})
            assert np.float32(reward) == np.float32(episode.rewards[step])
        assert terminated
        assert episode.terminations[-1]
    env.close()


@pytest.mark.parametrize("format", export.FORMATS)
def test_an_export_may_be_repeated_also_where_it_was_killed(demos, tmp_path, monkeypatch, format):
    monkeypatch.setitem(os.environ, "MINARI_DATASETS_PATH", "")
    given = ["--demos", str(demos["grasp"]), "--format", format, "--out", str(tmp_path / "out")]
    found = []
    for _ in range(2):
        assert main(["export-demos", "--episodes", "1", *given]) == 0
        (tmp_path / "out" / export.CARD).unlink()  # written last
        found.append(sorted(str(path) for path in tmp_path.rglob("*")))
    assert found[0] == found[1]
    (tmp_path / "out" / "mine").touch()
    assert main(["export-demos", *given]) == 2


def test_an_export_is_named_by_the_task_of_its_demonstrations(demos, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = ["export-demos", "--episodes", "1", "--demos", str(demos["insert"])]
    assert main(given) == 0
    assert [path.name for path in tmp_path.glob("outputs/transitions/*")] == ["insert-relative-npz"]
    assert main([*given, "--task", "grasp"]) == 2
    assert "shows insert; leave --task out" in capsys.readouterr().err


@pytest.fixture(scope="module", params=["goal", "relative"])
def exported(request, demos, tmp_path_factory) -> tuple[Path, Transitions]:
    out = tmp_path_factory.mktemp("robomimic") / request.param
    given = ["--demos", str(demos["grasp"]), "--obs-type", request.param, "--out", str(out)]
    assert main(["export-demos", "--format", "robomimic", *given]) == 0
    return out / "demo.hdf5", of_demos(list_demos(demos["grasp"]), obs_type=request.param)


def names_of(found: Transitions) -> dict[str, str]:
    return {key: key if found.is_goal else export.ROBOMIMIC_FLAT for key in found.observation}


def test_robomimic_s_file_holds_the_transitions(exported):
    path, found = exported
    with h5py.File(path) as file:
        data = file["data"]
        assert data.attrs["total"] == len(found)
        told = json.loads(data.attrs["env_args"])
        env = gymnasium.make(told["env_name"], **told["env_kwargs"])
        assert env.observation_space == export.space_of(found)
        env.close()
        start = 0
        for number in range(found.episodes):
            demo = data[f"demo_{number}"]
            rows = slice(start, start + demo.attrs["num_samples"])
            start = rows.stop
            assert demo.attrs["seed"] == found.seeds[number]
            np.testing.assert_array_equal(demo["actions"], found.action[rows])
            np.testing.assert_array_equal(demo["rewards"], found.reward[rows])
            assert demo["dones"][:].tolist() == [0] * (len(demo["dones"]) - 1) + [1]
            for key, name in names_of(found).items():
                np.testing.assert_array_equal(demo[f"obs/{name}"], found.observation[key][rows])
                after = found.next_observation[key][rows]
                np.testing.assert_array_equal(demo[f"next_obs/{name}"], after)
        assert start == len(found)
        assert [name.decode() for name in file["mask/train"]] == ["demo_0", "demo_1"]
        assert "valid" not in file["mask"]


def test_robomimic_reads_it(exported):
    """Round trip through the real library's own reader."""
    pytest.importorskip(
        "robomimic", reason="robomimic is not installed; pip install --no-deps robomimic==0.3.0"
    )
    import robomimic.utils.obs_utils as obs_utils
    from robomimic.utils.dataset import SequenceDataset

    path, found = exported
    keys = list(names_of(found).values())
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": keys, "rgb": []}})
    dataset = SequenceDataset(
        hdf5_path=str(path),
        obs_keys=keys,
        dataset_keys=("actions", "rewards", "dones"),
        seq_length=1,
        hdf5_cache_mode=None,
        hdf5_use_swmr=False,
        filter_by_attribute="train",
        load_next_obs=True,
    )
    assert len(dataset) == len(found)
    for row in range(0, len(found), 7):
        item = dataset[row]
        np.testing.assert_array_equal(item["actions"][0], found.action[row])
        assert item["rewards"][0] == found.reward[row]
        for key, name in names_of(found).items():
            np.testing.assert_array_equal(item["obs"][name][0], found.observation[key][row])
            after = found.next_observation[key][row]
            np.testing.assert_array_equal(item["next_obs"][name][0], after)
    dataset.close_and_delete_hdf5_handle()
