"""Cameras: they have the published poses, and the wrist cameras see what they aim at."""

import math
from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from surgicai_vision.core import cameras
from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.names import (
    ARMS,
    CAMERAS,
    CROPS,
    ENDOSCOPE_CAMERAS,
    FIXED_CAMERAS,
    PARTS,
)
from surgicai_vision.core.plugins import NameCollision
from surgicai_vision.scene import build_scene, kinematics
from surgicai_vision.scene.cameras import CameraPose, extrinsics, intrinsics, look_at
from surgicai_vision.scene.rendering import FrameRenderer

SIZE = (224, 224)


def at_start(instrument: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the scene with both tools at their starts and the jaws open."""
    model = build_scene(SceneConfig(instrument=instrument)).model
    data = mujoco.MjData(model)
    for arm in ARMS:
        joints = kinematics.inverse(kinematics.start_in_base(arm), instrument)
        for name, value in zip(kinematics.DVRK_JOINTS, joints, strict=True):
            data.joint(f"{arm}_{name}").qpos = value
        for side in ("left", "right"):
            data.joint(f"{arm}_{side}_finger").qpos = 0.4
    mujoco.mj_forward(model, data)
    return model, data


def stand(name: str) -> CameraPose:
    """Return a fixed camera's pose in world."""
    pose = cameras.CAMERAS.load(name)
    assert isinstance(pose, CameraPose)
    return pose


@pytest.fixture(scope="module", params=sorted(kinematics.INSTRUMENTS))
def start(request):
    return at_start(request.param)


def test_the_scene_has_the_named_cameras(start):
    model, _ = start
    standing = [name for name in CAMERAS if name not in CROPS]
    assert sorted(model.camera(index).name for index in range(model.ncam)) == sorted(standing)


@pytest.mark.parametrize("name", [*FIXED_CAMERAS, *ENDOSCOPE_CAMERAS])
def test_world_cameras_stand_where_the_table_says(start, name):
    model, data = start
    pose, table = extrinsics(model, data, name), stand(name)
    assert np.allclose(pose[:3, 3], table.position, atol=1e-12)
    assert np.allclose(
        pose[:3, 2], np.array(table.direction) / np.linalg.norm(table.direction), atol=1e-6
    )
    across = np.cross(table.direction, table.up)
    assert math.isclose(pose[:3, 0] @ across, np.linalg.norm(across), rel_tol=1e-6)
    focal = intrinsics(model, name, 480, 640)[1, 1]
    assert math.isclose(2 * math.atan(240 / focal), table.fovy, rel_tol=1e-9)


def test_endoscopes_are_4_mm_apart_and_toed_in(start):
    model, data = start
    left, right = extrinsics(model, data, "front"), extrinsics(model, data, "front_right")
    right_in_left = (np.linalg.inv(left) @ right)[:3, 3]
    assert math.isclose(right_in_left[0], 0.004, abs_tol=2e-5)  # to the right, as OpenCV's x goes
    assert math.isclose(math.degrees(math.acos(left[:3, 2] @ right[:3, 2])), 2 * 2.3, abs_tol=0.1)


@pytest.mark.parametrize("arm", ARMS)
def test_wrist_cameras_see_their_own_jaws(start, arm):
    model, data = start
    camera, part = f"wrist_{arm}", PARTS.index(arm)
    grasp = np.array([*data.site(f"{arm}_grasp").xpos, 1.0])
    grasp_in_camera = (np.linalg.inv(extrinsics(model, data, camera)) @ grasp)[:3]
    pixel = (intrinsics(model, camera, *SIZE) @ grasp_in_camera / grasp_in_camera[2])[:2]
    assert np.all(np.abs(pixel - 111.5) < 45)  # well inside the image
    pads = [data.geom(f"{arm}_{side}_pad").xpos for side in ("left", "right")]
    with FrameRenderer(model, *SIZE) as renderer:
        parts = renderer.render(data, camera, "segmentation")[..., 0]
        depth = renderer.render(data, camera, "depth")[..., 0]
    seen = 0
    for pad in pads:
        pad_in_camera = (np.linalg.inv(extrinsics(model, data, camera)) @ [*pad, 1.0])[:3]
        u, v = np.rint(
            (intrinsics(model, camera, *SIZE) @ pad_in_camera / pad_in_camera[2])[:2]
        ).astype(int)
        seen += parts[v, u] == part and abs(depth[v, u] - pad_in_camera[2]) < 0.003
    assert seen >= 1  # one finger may hide the other


@pytest.mark.parametrize("camera", [*FIXED_CAMERAS, *ENDOSCOPE_CAMERAS])
def test_world_cameras_see_needle_phantom_and_both_arms(start, camera):
    model, data = start
    with FrameRenderer(model, *SIZE) as renderer:
        parts = renderer.render(data, camera, "segmentation")
    needle = int((parts == PARTS.index("needle")).sum())
    assert needle >= 25
    assert {PARTS.index(name) for name in ("phantom", *ARMS)} <= set(np.unique(parts))


def test_look_at_is_a_rotation():
    rotation = look_at((0.0, 3.0, -4.0), (0.0, 0.0, 1.0))
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert math.isclose(np.linalg.det(rotation), 1.0, abs_tol=1e-12)
    assert np.allclose(rotation[:, 2], (0.0, 0.6, -0.8), atol=1e-12)


def test_wrong_names_are_refused(start):
    model, data = start
    with pytest.raises(UnknownName, match="Did you mean 'front'"):
        extrinsics(model, data, "frnt")
    with pytest.raises(UnknownName, match="world"):
        CameraPose((0, 0, 1), (0, 0, -1), (0, 1, 0), 0.8, "tripod").add_to(
            mujoco.MjSpec(), "side", "400006"
        )


@pytest.fixture
def side() -> Iterator[str]:
    """A camera of another distribution, to the side of the scene."""
    pose = CameraPose((0.12, 0.03, 0.10), (-0.9, 0.0, -0.5), (0.0, 0.0, 1.0), 0.7)
    cameras.register_camera("side", pose)
    yield "side"
    cameras.CAMERAS.unregister("side")


def test_a_registered_camera_leaves_our_scene_as_it_was(side: str) -> None:
    cameras.CAMERAS.unregister(side)
    plain = build_scene()
    cameras.register_camera(
        side, CameraPose((0.12, 0.03, 0.10), (-0.9, 0.0, -0.5), (0.0, 0.0, 1.0), 0.7)
    )
    scene = build_scene()
    assert scene is build_scene() and scene.hash == plain.hash
    assert scene.model.ncam == plain.model.ncam + 1
    states, images = [], []
    for model in (plain.model, scene.model):
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 50)
        states.append(np.concatenate([data.qpos, data.qvel]))
        mujoco.mj_forward(model, data)
        with FrameRenderer(model, 64, 64) as renderer:
            standing = [name for name in CAMERAS if name not in CROPS]
            images.append([renderer.render(data, camera) for camera in standing])
            if model is scene.model:
                seen = renderer.render(data, side, "segmentation")
    np.testing.assert_array_equal(*states)
    np.testing.assert_array_equal(*images)
    assert PARTS.index("needle") in seen


def test_a_registered_camera_is_a_view_until_it_is_taken_out(side: str) -> None:
    assert cameras.camera_names() == (*CAMERAS, side)
    assert cameras.view_names()[-1] == "side_depth"
    assert cameras.check_view("side_depth") == "side_depth"
    with pytest.raises(NameCollision, match="'surgicai-vision'"):
        cameras.register_camera("front", stand("back"))
    for name in ("side view", "side_depth"):
        with pytest.raises(InputError, match=f"called '{name}'"):
            cameras.register_camera(name, stand("back"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fovy": 45}, "fovy is 45; .*in radians"),
        ({"fovy": 0.0}, "fovy is 0.0; .*in radians"),
        ({"fovy": "wide"}, "fovy is 'wide'; .*in radians"),
        ({"up": (0.0, 0.0, 2.0)}, "up must not lie along direction"),
        ({"direction": (0.0, 0.0, 0.0)}, "neither may be zero"),
        ({"position": (0.0, math.nan, 1.0)}, "position is .*three finite numbers"),
        ({"up": (0.0, 1.0)}, "up is .*three finite numbers"),
    ],
)
def test_what_no_camera_can_have_is_refused(change, message):
    pose = CameraPose((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 0.8)
    with pytest.raises(InputError, match=message):
        replace(pose, **change)


def test_a_camera_that_cannot_be_added_is_named() -> None:
    pose = CameraPose((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 0.8, "tripod")
    cameras.register_camera("aside", pose, "theirs")
    try:
        with pytest.raises(InputError, match=r"^The camera 'aside' of 'theirs'.*'tripod'"):
            build_scene()
    finally:
        cameras.CAMERAS.unregister("aside")
