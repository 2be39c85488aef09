"""Arms that give way: torque limits, commands that do not run away, friction by priority."""

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.core.errors import UnknownName
from surgicai_vision.envs.force_plate import ForcePlate
from surgicai_vision.scene import arm, build_scene
from surgicai_vision.scene.kinematics import DVRK_JOINTS

DOWN = 2


@pytest.mark.parametrize("preset", sorted(arm.TORQUES))
def test_every_servo_of_both_arms_has_the_presets_limit(preset: str) -> None:
    model = build_scene(SceneConfig(torque=preset)).model
    for name in names.ARMS:
        for joint, limit in zip(DVRK_JOINTS, arm.TORQUES[preset], strict=True):
            servo = model.actuator(f"{name}_{joint}")
            assert model.actuator_forcelimited[servo.id]
            assert list(model.actuator_forcerange[servo.id]) == [-limit, limit]


def test_an_unknown_preset_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UnknownName, match="effective"):
        SceneConfig(torque="efective")


def press(preset: str, steps: int) -> tuple[envs.SuturingEnv, list[float]]:
    """Press PSM2 straight down on the tissue; return the env and the force of every step [N]."""
    env = envs.make(TaskConfig("grasp", SceneConfig(torque=preset)))
    env.reset(seed=names.VALIDATION_SEED)
    simulation = env.simulation
    plate = ForcePlate(env.model)
    base = np.reshape(simulation.bases[names.PSM2][3:], (3, 3))
    action = np.zeros(7, np.float32)
    action[:3] = base.T @ [0.0, 0.0, -1.0]
    forces = []
    for _ in range(steps):
        env.step(action)
        forces.append(plate.force(env.data))
    return env, forces


def test_a_pressing_arm_holds_no_more_than_its_servos_allow() -> None:
    _, effective = press("effective", 200)
    _, motors = press("dvrk", 200)
    assert max(effective) > 1.0, "the arm never reached the tissue"
    assert np.median(effective[-40:]) <= 10.0
    assert np.median(motors[-40:]) > np.median(effective[-40:])


def test_a_command_does_not_run_away_from_an_arm_that_presses() -> None:
    env, _ = press("effective", 200)
    simulation = env.simulation
    before = simulation.tip(names.PSM2)[DOWN]
    up = np.zeros(7, np.float32)
    up[:3] = np.reshape(simulation.bases[names.PSM2][3:], (3, 3)).T @ [0.0, 0.0, 1.0]
    for _ in range(12):
        env.step(up)
    # 12 steps of 0.5 mm: with the command where the arm is, all but its lead is seen at once.
    assert simulation.tip(names.PSM2)[DOWN] - before > 0.001


def test_a_free_arm_is_told_what_it_was_told() -> None:
    env = envs.make(TaskConfig("place"))
    env.reset(seed=names.VALIDATION_SEED)
    rng = np.random.default_rng(0)
    for _ in range(50):
        command = env.simulation.commands[names.PSM2]
        assert env.simulation.within_reach(names.PSM2) is command
        env.step(rng.uniform(-1.0, 1.0, 7).astype(np.float32))


def test_needle_and_instruments_slide_on_tissue_by_the_tissues_friction() -> None:
    env = envs.make(TaskConfig("grasp"))
    env.reset(seed=names.VALIDATION_SEED)
    phantom = env.model.body("phantom").id
    tissue = [
        contact for contact in env.data.contact if phantom in env.model.geom_bodyid[contact.geom]
    ]
    assert tissue
    assert all(contact.friction[0] == pytest.approx(0.4) for contact in tissue)
