"""Action mode "absolute": the field's sixteen values drive the env and describe the arms."""

import math
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.store import Demo
from surgicai_vision.envs import SuturingEnv, absolute, poses


def absolute_env(config: TaskConfig) -> SuturingEnv:
    return envs.make(config, action_mode=names.ABSOLUTE)


@pytest.fixture(scope="module")
def env() -> SuturingEnv:
    env = absolute_env(TaskConfig("grasp"))
    env.reset(seed=1)
    return env


def demonstrated(task: str) -> Demo:
    env = envs.make(TaskConfig(task))
    return rollout(env, Expert(env), 3).demo


@pytest.mark.parametrize("task", ["grasp", "handoff", "suture"])
def test_setpoints_of_a_demonstration_replay_it(task: str) -> None:
    """The expert's set-points as actions replay its increments, PSM2's release included."""
    demo = demonstrated(task)
    env = absolute_env(demo.config)
    actions = []
    for state in demo.state[1:]:
        env.set_state_vector(state)
        actions.append(absolute.setpoints(env.simulation))
    env.set_state_vector(demo.state[0])
    positions = slice(1, 1 + env.model.nq)
    info = {}
    for action, state in zip(actions, demo.state[1:], strict=True):
        info = env.step(action)[4]
        np.testing.assert_allclose(env.get_state()[positions], state[positions], atol=1e-6)
    assert info["is_success"]
    turns = np.array(actions)[:, [*range(3, 7), *range(11, 15)]]
    assert np.abs(np.diff(turns, axis=0)).max() < 0.05, "a quaternion changed its sign"


def test_measured_values_are_the_world_s(env: SuturingEnv) -> None:
    values = env.absolute_pos()
    assert len(values) == len(names.ABSOLUTE_STATE_NAMES) == len(names.ABSOLUTE_ACTION_NAMES) == 16
    for index, arm in enumerate(names.ARMS):
        eight = values[8 * index : 8 * index + 8].astype(float)
        tip = poses.square(env.simulation.tip(arm))
        view = poses.square(absolute.T_WORLD_VIEW)
        np.testing.assert_allclose(view[:3, :3] @ eight[:3] + view[:3, 3], tip[:3, 3], atol=1e-6)
        turn = view[:3, :3] @ Rotation.from_quat(eight[3:7]).as_matrix()
        np.testing.assert_allclose(turn, tip[:3, :3], atol=1e-6)
        assert eight[7] == pytest.approx(2.0 * env.simulation.jaw(arm), abs=1e-6)
        assert eight[2] > 0.0, "the arms are before the endoscope"


@given(
    st.floats(-0.1, 0.1),
    st.floats(0.0, 0.2),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(
        lambda row: math.hypot(*row) > 0.1
    ),
    st.floats(0.0, 1.0),
    st.sampled_from(names.ARMS),
)
@settings(max_examples=50, deadline=None)
def test_values_and_poses_round_trip(
    x: float, z: float, quaternion: list[float], jaw: float, arm: str
) -> None:
    pose, finger = absolute.read(arm, [x, -x, z, *quaternion, 2.0 * jaw])
    eight = absolute._eight(arm, pose, finger)
    np.testing.assert_allclose(eight[:3], [x, -x, z], atol=1e-9)
    unit = np.array(quaternion) / math.hypot(*quaternion)
    assert abs(np.dot(eight[3:7], unit)) == pytest.approx(1.0, abs=1e-9)
    assert eight[7] / 2.0 == pytest.approx(jaw, abs=1e-12)


def test_a_far_setpoint_is_approached_by_leaps(env: SuturingEnv) -> None:
    env.reset(seed=1)
    start = absolute.setpoints(env.simulation).astype(float)
    far = start.copy()
    far[8:11] += [0.0, 0.01, 0.0]
    far[15] -= 1.0
    env.step(far.astype(np.float32))
    moved = absolute.setpoints(env.simulation).astype(float)
    np.testing.assert_allclose(moved[:8], start[:8], atol=1e-6)
    assert np.linalg.norm(moved[8:11] - start[8:11]) == pytest.approx(absolute.LEAP.translation)
    assert start[15] - moved[15] == pytest.approx(2.0 * absolute.LEAP.jaw, abs=1e-6)
    for _ in range(6):
        env.step(far.astype(np.float32))
    np.testing.assert_allclose(absolute.setpoints(env.simulation)[8:11], far[8:11], atol=1e-6)


def test_a_setpoint_out_of_reach_moves_the_jaw_alone(env: SuturingEnv) -> None:
    env.reset(seed=1)
    start = absolute.setpoints(env.simulation)
    away = start.copy()
    away[:3] = [0.4, 0.4, -0.4]
    away[7] -= 0.1
    for _ in range(60):
        env.step(away)
    x, y, z = poses.transform(
        env.simulation.bases[names.PSM1], poses.position(env.simulation.commands[names.PSM1].pose)
    )
    assert -0.09 <= x <= 0.09 and -0.09 <= y <= 0.14 and 0.06 <= z <= 0.165
    assert absolute.setpoints(env.simulation)[7] == pytest.approx(away[7], abs=1e-6)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda action: action[:7], "16 finite numbers"),
        (lambda action: np.where(np.arange(16) == 2, np.nan, action), "16 finite numbers"),
        (lambda action: np.where((np.arange(16) > 2) & (np.arange(16) < 7), 0, action), "zero"),
    ],
)
def test_what_is_no_setpoint_is_refused(
    env: SuturingEnv, spoil: Callable[[NDArray[np.float32]], NDArray[np.float32]], message: str
) -> None:
    env.reset(seed=1)
    before = env.get_state()
    with pytest.raises(InputError, match=message):
        env.step(spoil(absolute.setpoints(env.simulation)))
    np.testing.assert_array_equal(env.get_state(), before)


def test_options_of_increments_and_unknown_modes_are_refused() -> None:
    with pytest.raises(InputError, match="hold_jaw"):
        absolute_env(TaskConfig("place", hold_jaw=True))
    with pytest.raises(InputError, match="latency"):
        absolute_env(TaskConfig("place", randomisation=RandomisationConfig(latency=1)))
    with pytest.raises(UnknownName, match="action mode"):
        envs.make(TaskConfig("place"), action_mode="relative")


def test_gymnasium_finds_nothing_wrong_with_it() -> None:
    env = gymnasium.make(
        "surgicai_vision/Place-v0",
        obs_type="pixels_agent_pos",
        cameras=("front",),
        image_size=16,
        action_mode=names.ABSOLUTE,
    )
    assert env.action_space.shape == (16,)
    assert isinstance(env.observation_space, gymnasium.spaces.Dict)
    assert env.observation_space["agent_pos"].shape == (16,)
    check_env(env.unwrapped, skip_render_check=True)
    assert envs.make(TaskConfig("place")).action_space.shape == (7,)
