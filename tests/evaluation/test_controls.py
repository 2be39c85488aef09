"""Controls: the state as an upper bound, and the mean demonstration replayed blindly."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.commands import folders
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.evaluation.agents import PolicyAgent, ReplayAgent, mean_demonstration
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.training.run_config import RunConfig


def test_mean_demonstration_is_over_those_that_still_run() -> None:
    action = np.arange(5, dtype=np.float32)[:, None] * np.ones(7, np.float32)
    mean = mean_demonstration(action, np.array([0, 0, 1, 1, 1]))
    np.testing.assert_allclose(mean[:, 0], [(0 + 2) / 2, (1 + 3) / 2, 4])


def test_replay_plays_to_its_end_in_every_slot() -> None:
    agent = ReplayAgent(np.array([[0.1] * 7, [0.2] * 7], np.float32))
    for slot in (0, 1):
        agent.reset(slot, None, 0)
    first = [agent.act([0], [None], [None])[0, 0] for _ in range(3)]
    np.testing.assert_allclose(first, [0.1, 0.2, 0.0])
    np.testing.assert_allclose(agent.act([1, 0], [None] * 2, [None] * 2)[:, 0], [0.1, 0.0])
    agent.reset(0, None, 1)
    assert agent.act([0], [None], [None])[0, 0] == np.float32(0.1)


def test_replay_of_one_demonstration_repeats_it_where_it_was_recorded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: object
) -> None:
    config = TaskConfig("grasp")
    env = envs.make(config)
    env.reset(seed=names.TEST_SEED)
    actions, ended = [], False
    while not ended:
        actions.append(Expert(env).action())
        _, _, terminated, truncated, _ = env.step(actions[-1])
        ended = terminated or truncated
    dataset = SimpleNamespace(
        columns=lambda: {names.ACTION: np.stack(actions)},
        episode_index=np.zeros(len(actions), np.int64),
        config=config,
        fingerprint="one",
        fps=names.FPS,
    )
    monkeypatch.chdir(str(tmp_path))
    monkeypatch.setattr(folders, "open_dataset", lambda *_: dataset)
    assert main(["evaluate", "replay", "--episodes", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["policy"], result["successes"]) == ("replay", 1)
    assert result["time_steps"]["mean"] == len(actions)
    assert main(["evaluate", "expert", "--dataset", "x"]) == 2


def test_state_policy_sees_the_observation_of_obs_type_state() -> None:
    seen: list[np.ndarray] = []

    def act(features: None, vectors: np.ndarray) -> np.ndarray:
        seen.append(vectors.copy())
        return np.full((len(vectors), 7), 0.3, np.float32)

    fed = (names.PRIVILEGED_STATE,)
    agent = PolicyAgent("state", SimpleNamespace(act=act), None, (), 224, fed)
    evaluate(lambda: agent, TaskConfig("grasp", max_steps=3), [names.TEST_SEED], workers=1)
    env = envs.make(TaskConfig("grasp", max_steps=3), obs_type="state")
    observation, _ = env.reset(seed=names.TEST_SEED)
    for vectors in seen:
        np.testing.assert_array_equal(vectors[0], observation)
        observation, *_ = env.step(np.full(7, 0.3, np.float32))
    assert len(seen) == 3


def test_controls_have_their_names() -> None:
    assert RunConfig(privileged=True).name == "state"
    assert RunConfig().name == "proprioception"
