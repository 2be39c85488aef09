"""The set point and the measured pose: an action moves the set point, and the tool lags behind."""

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import StepSize
from surgicai_vision.scene.rotations import rotvec_to_matrix

TASKS = ("grasp", "pullout")


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("kinematic_error", [0.0, 0.5])
def test_measured_pose_and_offset_make_the_set_point(task: str, kinematic_error: float) -> None:
    world = RandomisationConfig(kinematic_error=kinematic_error)
    env = envs.make(TaskConfig(task, randomisation=world))
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    arm = env.subtask.arm
    for _ in range(5):
        env.step(rng.uniform(-1, 1, 7))
        offset = env.setpoint().astype(float)
        now = poses.square(env.simulation.tip_in_base(arm))
        told = env.simulation.commands[arm]
        expected = poses.square(told.pose)
        np.testing.assert_allclose(now[:3, 3] + offset[:3], expected[:3, 3], atol=1e-7)
        turned = rotvec_to_matrix(offset[3:6]) @ now[:3, :3]
        np.testing.assert_allclose(turned, expected[:3, :3], atol=1e-6)
        assert env.agent_pos()[6] + offset[6] == pytest.approx(told.jaw, abs=1e-6)


def test_an_action_moves_the_set_point_by_its_step() -> None:
    env = envs.make(TaskConfig("grasp"))
    env.reset(seed=0)
    arm = env.subtask.arm
    before = env.agent_pos()[:3] + env.setpoint()[:3]
    env.step(np.array([1.0, 0, 0, 0, 0, 0, 0]))
    after = env.agent_pos()[:3] + env.setpoint()[:3]
    step = StepSize.of(env.config.step).translation
    np.testing.assert_allclose(after - before, [step, 0, 0], atol=1e-6)
    assert np.linalg.norm(env.setpoint()[:3]) > 0.1 * step, f"{arm} did not lag behind"
