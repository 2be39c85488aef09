"""The endoscope: a da Vinci's two eyes as one rig, at a working distance, clear of both arms."""

import math

import mujoco
import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.scene import build_scene
from surgicai_vision.scene.cameras import (
    DA_VINCI_BASELINE,
    DA_VINCI_FOCAL,
    DA_VINCI_SHAFT,
    DA_VINCI_SIZE,
    DA_VINCI_TILT,
    ENDOSCOPE,
    extrinsics,
    intrinsics,
)
from surgicai_vision.scene.compose import build_spec

CLEARANCE = 0.030
"""Least distance between the shaft's surface and an arm [m]."""


@pytest.fixture(scope="module")
def eyes() -> tuple[np.ndarray, np.ndarray]:
    model = build_scene().model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return extrinsics(model, data, "endo_left"), extrinsics(model, data, "endo_right")


def test_the_eyes_are_a_baseline_apart_and_parallel(eyes: tuple[np.ndarray, np.ndarray]) -> None:
    left, right = eyes
    right_in_left = np.linalg.inv(left) @ right
    np.testing.assert_allclose(right_in_left[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(right_in_left[:3, 3], [DA_VINCI_BASELINE, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose((left + right)[:3, 3] / 2.0, ENDOSCOPE, atol=1e-12)


@pytest.mark.parametrize("eye", names.ENDOSCOPE_CAMERAS)
def test_an_eye_has_the_published_focal_length(eye: str) -> None:
    K = intrinsics(build_scene().model, eye, *DA_VINCI_SIZE)
    np.testing.assert_allclose([K[0, 0], K[1, 1]], DA_VINCI_FOCAL, rtol=1e-9)
    wide, high = (
        2.0 * math.degrees(math.atan(side / 2.0 / DA_VINCI_FOCAL)) for side in DA_VINCI_SIZE[::-1]
    )
    assert math.isclose(wide, 61.1, abs_tol=0.05)
    assert math.isclose(high, 50.6, abs_tol=0.05)


def test_it_works_at_50_to_150_mm(eyes: tuple[np.ndarray, np.ndarray]) -> None:
    pair = build_scene().pair
    for hole in (pair.entry, pair.exit):
        depth = (np.linalg.inv(eyes[0]) @ [*hole.centre, 1.0])[2]
        assert 0.05 < depth < 0.15


def test_both_eyes_move_as_one() -> None:
    axes = RandomisationConfig(camera_turn=3.0, camera_shift=3.0, camera_fovy=3.0)
    env = envs.make(TaskConfig(randomisation=axes))
    env.reset(seed=0)
    left, right = (extrinsics(env.model, env.data, eye) for eye in names.ENDOSCOPE_CAMERAS)
    right_in_left = np.linalg.inv(left) @ right
    np.testing.assert_allclose(right_in_left[:3, :3], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(right_in_left[:3, 3], [DA_VINCI_BASELINE, 0.0, 0.0], atol=1e-9)
    fovy = [env.model.camera(eye).fovy for eye in names.ENDOSCOPE_CAMERAS]
    assert fovy[0] == fovy[1] != build_scene().model.camera("endo_left").fovy


@pytest.mark.parametrize("task", ["place", "handoff", "pullout"])
def test_its_shaft_is_clear_of_both_arms(task: str, eyes: tuple[np.ndarray, np.ndarray]) -> None:
    """The 30° endoscope, looking down, over a whole episode of the expert."""
    view = eyes[0][:3, 2]
    upwards = -eyes[0][:3, 1]
    along = math.cos(DA_VINCI_TILT) * view + math.sin(DA_VINCI_TILT) * upwards
    env = envs.make(TaskConfig(task))
    spec = build_spec(env.config.scene)
    spec.worldbody.add_geom(
        name="shaft",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[DA_VINCI_SHAFT, 0.0, 0.0],
        fromto=[*ENDOSCOPE, *(np.array(ENDOSCOPE) - 0.3 * along)],
        contype=0,
        conaffinity=0,
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    shaft = model.geom("shaft").id
    parts = [
        geom
        for geom in range(model.ngeom)
        if model.body(int(model.geom_bodyid[geom])).name.startswith(names.ARMS)
        and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE
    ]
    env.reset(seed=0)
    expert = Expert(env)
    nearest = math.inf
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(expert.action())
        ended = terminated or truncated
        data.qpos[:] = env.data.qpos
        mujoco.mj_kinematics(model, data)
        for geom in parts:
            nearest = min(nearest, mujoco.mj_geomDistance(model, data, shaft, geom, 0.1, None))
    assert nearest > CLEARANCE
