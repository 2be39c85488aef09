"""Looks: images show what the physics has, and what is only seen does not change it."""

import cv2
import mujoco
import numpy as np
import pytest

from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.names import ARMS, LAYOUTS, PARTS
from surgicai_vision.scene import build_scene, build_spec, holes, kinematics, needle
from surgicai_vision.scene.cameras import extrinsics, intrinsics
from surgicai_vision.scene.rendering import FrameRenderer
from surgicai_vision.scene.visual import materials, textures
from surgicai_vision.scene.visual.shapes import VISIBLE, block, rod

SIZE = (480, 480)


def at_start(model: mujoco.MjModel, opening: float = 0.4) -> mujoco.MjData:
    """Return both tools at their starts, with the jaws open by `opening` [rad]."""
    data = mujoco.MjData(model)
    for arm in ARMS:
        for name, value in zip(
            kinematics.DVRK_JOINTS, kinematics.inverse(kinematics.start_in_base(arm)), strict=True
        ):
            data.joint(f"{arm}_{name}").qpos = value
            data.actuator(f"{arm}_{name}").ctrl = value
        for side in ("left", "right"):
            data.joint(f"{arm}_{side}_finger").qpos = opening
    mujoco.mj_forward(model, data)
    return data


@pytest.fixture(scope="module")
def model():
    return build_scene(SceneConfig()).model


def test_visible_shapes_neither_collide_nor_weigh(model):
    seen = model.geom_group == VISIBLE
    assert seen.sum() > 10
    assert not model.geom_contype[seen].any()
    assert not model.geom_conaffinity[seen].any()


def test_physics_is_the_same_without_the_looks(model, monkeypatch):
    monkeypatch.setattr(materials, "dress", lambda *_: None)
    monkeypatch.setattr(materials, "add_surroundings", lambda _: None)
    plain = build_spec(SceneConfig()).compile()
    assert plain.ngeom < model.ngeom
    states = []
    for each in (model, plain):
        data = at_start(each)
        rng = np.random.default_rng(0)
        for _ in range(10):
            data.ctrl += 0.03 * rng.standard_normal(each.nu)
            mujoco.mj_step(each, data, 30)
        states.append(data.qpos.copy())
    assert np.array_equal(*states)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_skin_lies_on_the_flanks_and_the_holes_are_open(layout):
    """The depth at each hole's rim is that of the flank; at its centre it is greater."""
    model = build_scene(SceneConfig(layout=layout)).model
    data = at_start(model)
    T_world_camera, matrix = extrinsics(model, data, "back"), intrinsics(model, "back", *SIZE)
    with FrameRenderer(model, *SIZE) as renderer:
        depth = renderer.render(data, "back", "depth")[..., 0]

    def beyond(point):
        """Return how much further than `point` the camera sees along its ray [m]."""
        in_camera = (np.linalg.inv(T_world_camera) @ [*point, 1.0])[:3]
        u, v = np.rint((matrix @ in_camera / in_camera[2])[:2]).astype(int)
        return depth[v, u] - in_camera[2]

    for pair in holes.PAIRS[layout][:2]:  # the camera sees the first two
        for hole in (pair.entry, pair.exit):
            assert beyond(np.array(hole.centre)) > 0.0005
            for shift in (-0.0025, 0.0025):
                assert abs(beyond(hole.centre + hole.rotation @ [0.0, shift, 0.0])) < 0.0005


def test_the_drawn_needle_is_the_physical_one(model):
    mesh = model.mesh("needle")
    points = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    geom = next(i for i in range(model.ngeom) if model.geom_dataid[i] == mesh.id)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    in_needle = points @ rotation.reshape(3, 3).T + model.geom_pos[geom]
    arc = needle.polyline(500)
    distance = np.linalg.norm(in_needle[:, None] - arc, axis=2).min(axis=1)
    assert distance.max() < needle.BODY_RADIUS + 0.00005
    assert np.linalg.norm(in_needle - needle.point(needle.TIP_ANGLE), axis=1).min() < 0.0003


@pytest.mark.parametrize("camera", ["front", "back"])
def test_images_are_bright_and_coloured_everywhere(model, camera):
    with FrameRenderer(model, 224, 224) as renderer:
        data = at_start(model)
        image = renderer.render(data, camera).astype(int)
        parts = renderer.render(data, camera, "segmentation")[..., 0]
    assert image[parts == 0].max(axis=1).min() > 30  # no black background
    needle_colour = image[parts == PARTS.index("needle")].mean()
    tissue_colour = image[parts == PARTS.index("phantom")].mean()
    assert needle_colour > tissue_colour + 40  # lit steel that does not glow
    assert (image == 255).all(axis=2).mean() < 0.01


def test_jaws_are_seen_to_open(model):
    with FrameRenderer(model, 224, 224) as renderer:
        shut, wide = (renderer.render(at_start(model, angle), "back") for angle in (0.0, 0.8))
    assert (shut != wide).any(axis=2).sum() > 100


def test_textures_are_the_same_bytes_each_time():
    first, second = textures.tissue(128, 64), textures.tissue(128, 64)
    assert np.array_equal(first, second)
    assert not np.array_equal(first, textures.tissue(128, 64, seed=5))
    decoded = cv2.imdecode(np.frombuffer(textures.png(first), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decoded[..., ::-1], first)


def test_cloth_tiles():
    cloth = textures.cloth(64).astype(int)
    steps = np.abs(np.diff(cloth, axis=0)).mean()
    seam = np.abs(cloth[0] - cloth[-1]).mean()
    assert seam < 2 * steps


def test_a_texture_changes_the_scene_hash(monkeypatch):
    before = build_spec(SceneConfig()).to_xml()
    assert before == build_spec(SceneConfig()).to_xml()
    original = textures.tissue
    monkeypatch.setattr(textures, "tissue", lambda: original(seed=9))
    assert build_spec(SceneConfig()).to_xml() != before


@pytest.mark.parametrize(
    "mesh", [block((1, 2, 3), (0.1, 0.2, 0.3)), rod((0, 0, 0), (0, 1, 1), 0.2)]
)
def test_solids_are_closed_and_face_outwards(mesh):
    points = np.array(mesh.points)
    centre = points.mean(axis=0)
    corners = points[np.array(mesh.faces)]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.allclose(areas.sum(axis=0), 0, atol=1e-12)
    wide = np.linalg.norm(areas, axis=1) > 1e-9
    assert (np.einsum("ij,ij->i", areas, corners.mean(axis=1) - centre)[wide] > 0).all()
