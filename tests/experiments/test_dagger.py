"""DAgger: a learner drives, the expert labels; the seed, not the workers, decides the result."""

import json
from pathlib import Path

import numpy as np
import pytest
from checkpoints import checkpoint
from fake_env import FakeEnv, FakeExpert

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import open_dataset, render_demos
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.store import read_demo, read_marker
from surgicai_vision.experiments.dagger import MixturePolicy, learner_of

CONFIG = TaskConfig("place", max_steps=160)


class Backwards:
    """A learner that goes the wrong way, with commands beyond the limit."""

    def reset(self, slot, env, seed):
        self.begun = seed

    def act(self, slots, envs, observations):
        assert observations[0] is not None
        return np.full((1, 7), -3.0)


@pytest.fixture(scope="module")
def learner(tmp_path_factory):
    """An untrained policy that sees no image."""
    return learner_of(
        Path(checkpoint(tmp_path_factory.mktemp("learner") / "policy", "place")), CONFIG
    )


@pytest.fixture(scope="module")
def driven(learner, tmp_path_factory):
    """Three recorded episodes."""
    out = tmp_path_factory.mktemp("demos") / "driven"
    return record(CONFIG, episodes=3, seed=1000, out=out, learner=learner)


def test_the_learner_drives_until_the_expert_takes_over():
    config = TaskConfig(max_steps=40)
    env, mixture = FakeEnv(config), MixturePolicy(Backwards())
    plain = rollout(env, FakeExpert(env), 3).demo
    driven = rollout(env, FakeExpert(env), 3, behaviour=mixture).demo
    wrong = (driven.executed == -1.0).all(axis=1)
    handed = int(wrong.sum())
    assert 0 < handed < 40 and wrong[:handed].all(), "first the learner, then the expert to the end"
    np.testing.assert_array_equal(driven.executed[handed:], driven.action[handed:])
    assert driven.success[-1] and len(driven.action) > len(plain.action)
    demos = [rollout(env, FakeExpert(env), seed, behaviour=mixture).demo for seed in range(8)]
    lengths = {int((demo.executed == -1.0).all(axis=1).sum()) for demo in demos}
    assert len(lengths) > 4, "each episode draws its own step"


def test_labels_are_the_experts_at_the_learners_states(driven, learner):
    env = envs.make(CONFIG)
    expert, strayed = Expert(env), 0.0
    env.reset(seed=0)
    for path in driven:
        demo = read_demo(path)
        assert demo.success[-1]
        for state, label in list(zip(demo.state, demo.action, strict=False))[::10]:
            env.set_state_vector(state)
            np.testing.assert_array_equal(expert.action(), label)
        strayed = max(strayed, float(np.abs(demo.executed - demo.action).max()))
    assert strayed > 0.5, "an untrained learner does something else"


def test_workers_and_repetition_change_nothing(driven, learner, tmp_path):
    again = record(
        CONFIG,
        episodes=3,
        seed=1000,
        out=tmp_path / "again",
        learner=learner,
        context=RunContext(2),
    )
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in driven]
    request = read_marker(tmp_path / "again")["request"]
    assert request["learner"] == learner.digest
    with pytest.raises(OutputExists):
        record(CONFIG, episodes=3, seed=1000, out=tmp_path / "again")


def test_a_learner_of_another_task_and_a_folder_without_one_are_refused(learner, tmp_path):
    with pytest.raises(InputError, match="trained for 'place', not for 'grasp'"):
        learner_of(learner.folder, TaskConfig("grasp"))
    with pytest.raises(InputError, match="is not one trained policy"):
        learner_of("expert", CONFIG)
    with pytest.raises(BadFile):
        learner_of(tmp_path, CONFIG)


def test_both_rounds_become_one_dataset(driven, tmp_path):
    first = record(CONFIG, episodes=2, out=tmp_path / "first")
    folders = [tmp_path / "first", driven[0].parent]
    summary = render_demos(folders, tmp_path / "both", views=("front",), size=16, frame_stride=5)
    assert summary.episodes == 5
    dataset = open_dataset(tmp_path / "both")
    lengths = [stop - start for start, stop in dataset.bounds()]
    assert lengths == [len(range(0, len(read_demo(path)), 5)) for path in [*first, *driven]]
    meta = json.loads((tmp_path / "both/meta/surgicai.json").read_text())
    assert [request["seed"] for request in meta["demos_requests"]] == [0, 1000]
    other = record(TaskConfig("insert"), episodes=1, out=tmp_path / "insert")
    with pytest.raises(BadFile, match="not made with the same task and scene"):
        render_demos(
            [tmp_path / "first", other[0].parent], tmp_path / "mixed", views=("front",), size=16
        )
