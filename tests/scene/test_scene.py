"""The compiled scene: it has the declared numbers, and the laws of mechanics hold in it."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.core.errors import InputError, SurgicaiError, UnknownName
from surgicai_vision.core.names import ARMS, LAYOUTS, SUBTASKS
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene import build_scene, compose, holes, kinematics, needle, phantom
from surgicai_vision.scene.kinematics import DVRK_JOINTS, INSTRUMENTS

GRAVITY = 9.81
WARNINGS = range(int(mujoco.mjtWarning.mjNWARNING))


@pytest.fixture
def simulation():
    return Simulation(build_scene(SceneConfig()))


def warnings_of(data):
    return {mujoco.mjtWarning(index).name for index in WARNINGS if data.warning[index].number}


# -- the arms --------------------------------------------------------------------------------------


@pytest.mark.parametrize("instrument", sorted(INSTRUMENTS))
@pytest.mark.parametrize("arm", ARMS)
def test_the_kinematic_tree_is_the_closed_form(arm, instrument):
    scene = build_scene(SceneConfig(instrument=instrument))
    data, ids = mujoco.MjData(scene.model), scene.arms[arm]
    low, high = kinematics.limits(instrument).T
    base, rng = kinematics.base_in_world(arm), np.random.default_rng(0)
    for _ in range(50):
        joints = rng.uniform(low, high)
        data.qpos[ids.qpos] = joints
        mujoco.mj_kinematics(scene.model, data)
        tip = base @ kinematics.forward(joints, instrument)
        assert np.allclose(data.xpos[ids.tip_body], tip[:3, 3], rtol=0, atol=1e-10)
        assert np.allclose(data.xmat[ids.tip_body].reshape(3, 3), tip[:3, :3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("instrument", sorted(INSTRUMENTS))
def test_the_model_has_the_declared_limits(instrument):
    scene = build_scene(SceneConfig(instrument=instrument))
    for arm in ARMS:
        for name, limits in zip(DVRK_JOINTS, kinematics.limits(instrument), strict=True):
            joint = scene.model.joint(f"{arm}_{name}")
            assert bool(joint.limited[0])
            assert np.allclose(joint.range, limits, rtol=0, atol=1e-12)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", [0, 1])
def test_joint_limits_hold_under_pushing(joint, side):
    """A servo commanded half a radian (5 cm) past a limit ends at it."""
    scene = build_scene(SceneConfig())
    model, data, ids = scene.model, mujoco.MjData(scene.model), scene.arms["psm1"]
    limits, outwards = kinematics.limits(), 2 * side - 1
    joints = limits.mean(axis=1)
    joints[2] = 0.1
    joints[joint] = limits[joint, side] - outwards * 0.01
    data.qpos[scene.needle_qpos.start + 2] = 5.0
    data.qpos[ids.qpos] = data.ctrl[ids.actuators] = joints
    data.ctrl[ids.actuators.start + joint] += outwards * (0.05 if joint == 2 else 0.5)
    beyond = []
    for _ in range(250):
        mujoco.mj_step(model, data)
        beyond.append(outwards * (data.qpos[ids.qpos.start + joint] - limits[joint, side]))
    assert beyond[-1] > -1e-3  # it did reach the limit
    assert beyond[-1] < 5e-4
    assert max(beyond) < (0.005 if joint == 2 else 0.012)  # [m or rad], on impact
    assert not warnings_of(data)


@pytest.mark.parametrize("axis", range(6))
def test_an_env_never_leaves_the_joint_limits(axis):
    env = envs.make(TaskConfig("grasp", step="shipped", max_steps=10**6))
    env.reset(seed=0)
    low, high = kinematics.limits().T
    for direction in (1.0, -1.0):
        action = np.zeros(7, np.float32)
        action[axis] = direction
        for _ in range(150):
            _, _, _, _, info = env.step(action)
            joints = env.data.qpos[env.scene.arms["psm2"].qpos]
            assert (joints > low - 5e-4).all() and (joints < high + 5e-4).all()
            assert not info["physics_error"]


@pytest.mark.parametrize("task", SUBTASKS)
def test_zero_action_holds_still(task):
    env = envs.make(TaskConfig(task, max_steps=10**6))
    env.reset(seed=4)
    simulation = env.simulation
    before = {arm: simulation.tip(arm)[:3] for arm in ARMS}
    held = simulation.needle()
    for _ in range(50):
        env.step(np.zeros(7, np.float32))
    for arm in ARMS:
        assert math.dist(simulation.tip(arm)[:3], before[arm]) < 5e-5
    assert poses.distance(simulation.needle(), held) < 2e-4
    assert poses.angle(simulation.needle(), held) < math.radians(1.0)


# -- the needle ------------------------------------------------------------------------------------


def test_the_needle_is_one_rigid_arc(simulation):
    model, data = simulation.model, simulation.data
    body = model.body("needle")
    assert body.dofnum[0] == 6
    assert math.isclose(body.mass[0], needle.MASS, rel_tol=1e-9)
    rng = np.random.default_rng(1)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.linalg.qr(rng.normal(size=(3, 3)))[0], (0.01, 0.02, 0.2)
    pose[:3, 0] *= np.linalg.det(pose[:3, :3])
    simulation.pose_needle(poses.flat(pose))
    mujoco.mj_kinematics(model, data)
    ends = []
    for index in simulation.scene.needle_geoms:
        assert model.geom_bodyid[index] == body.id
        half = model.geom_size[index, 1] * data.geom_xmat[index].reshape(3, 3)[:, 2]
        ends.append(
            (data.geom_xpos[index] + half, data.geom_xpos[index] - half)
        )  # a capsule's z runs from end to start
    line = np.array([ends[0][0], *(end for _, end in ends)])
    local = (line - pose[:3, 3]) @ pose[:3, :3]
    angles = np.unwrap(np.arctan2(local[:, 1], -local[:, 0]))
    assert np.allclose(np.linalg.norm(local, axis=1), needle.RADIUS, rtol=0, atol=1e-9)
    assert np.allclose(
        angles, np.linspace(0.0, math.radians(120.0), needle.SEGMENTS + 1), rtol=0, atol=1e-6
    )
    assert np.allclose(
        [start for start, _ in ends[1:]], [end for _, end in ends[:-1]], rtol=0, atol=1e-9
    )
    radii = model.geom_size[list(simulation.scene.needle_geoms), 0]
    assert (
        radii[0] == needle.BODY_RADIUS
        and (np.diff(radii) <= 0).all()
        and radii[-1] < 0.6 * radii[0]
    )
    for site, angle in (("needle_base", 0.0), ("needle_tip", needle.TIP_ANGLE)):
        assert np.allclose(
            data.site(site).xpos,
            pose[:3, :3] @ needle.point(angle) + pose[:3, 3],
            rtol=0,
            atol=1e-9,
        )


def test_the_needle_falls_at_g(simulation):
    """Within the half percent that its declared drag costs."""
    model, data = simulation.model, simulation.data
    start = simulation.scene.needle_qpos.start
    dof = model.joint("needle").dofadr[0]
    data.qpos[start : start + 3] = (0.3, 0.3, 3.0)
    steps = 250
    mujoco.mj_step(model, data, steps)
    time = steps * model.opt.timestep
    fallen = 3.0 - data.qpos[start + 2]
    # The explicit integrator sums to n (n + 1) / 2 where the continuum gives n² / 2.
    assert math.isclose(fallen, GRAVITY * time**2 / 2 * (1 + 1 / steps), rel_tol=0.005)
    assert math.isclose(-data.qvel[dof + 2], GRAVITY * time, rel_tol=0.005)
    assert np.allclose(data.qpos[start : start + 2], 0.3, atol=1e-4)
    assert math.isclose(np.linalg.norm(data.qpos[start + 3 : start + 7]), 1.0, abs_tol=1e-12)


@pytest.mark.parametrize(("x", "y"), [(0.043, 0.0), (0.0, 0.105), (0.12, 0.0), (-0.3, 0.5)])
def test_a_needle_that_falls_from_the_phantom_comes_to_rest_below_it(simulation, x, y):
    """On the tray's rim, which is narrower than the needle, or flat on the table."""
    data, model = simulation.data, simulation.model
    data.qpos[simulation.scene.needle_qpos] = [x, y, phantom.TABLE + 0.08, 1.0, 0.0, 0.0, 0.0]
    mujoco.mj_step(model, data, 1500)
    above = data.geom_xpos[simulation.scene.needle_geoms, 2] - phantom.TABLE
    assert above.min() > 0.0 and above.max() < phantom.TRAY_HEIGHT + 0.01
    assert np.abs(data.joint("needle").qvel).max() < 0.05
    assert not warnings_of(data)


# -- the holes -------------------------------------------------------------------------------------

ENTRIES = ((-3.740, 44.189), (-4.316, 20.691), (-3.337, -2.032), (-4.394, -27.678))
"""x and y [mm] of the entries of SurgicAI's phantom."""


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_the_holes_of_the_simple_layout_are_surgicais(number):
    pair, (x, y) = holes.PAIRS["simple"][number - 1], ENTRIES[number - 1]
    assert np.allclose(np.array(pair.entry.centre) * 1e3, (x, y, 75.004), rtol=0, atol=1e-9)
    assert np.allclose(np.array(pair.exit.centre) * 1e3, (4.078, y, 74.860), rtol=0, atol=1e-9)
    assert (pair.entry.tilt, pair.exit.tilt) == (-0.8053, 0.8053)
    assert 0.0074 < pair.gap < 0.0085
    for hole, outwards in ((pair.entry, -1.0), (pair.exit, 1.0)):
        normal = hole.rotation[:, 2]
        assert np.allclose(normal, (outwards * math.sin(0.8053), 0.0, math.cos(0.8053)), atol=1e-12)


@pytest.mark.parametrize(
    ("layout", "clearance"), [("simple", 0.70), ("3dmed", 0.45), ("3dmed_straight", 1.20)]
)
@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_the_circle_through_both_holes_clears_the_phantom(layout, clearance, number):
    """From the tip in the entry until the base is out; `clearance` [mm] is between surfaces."""
    scene = build_scene(SceneConfig(layout=layout, hole_pair=number))
    simulation, stitch = Simulation(scene), Stitch.of(scene.pair)
    model, data = simulation.model, simulation.data
    touchable = model.geom_conaffinity & model.geom_contype[scene.needle_geoms[0]]
    tissue = np.flatnonzero((model.geom_bodyid == model.body("phantom").id) & (touchable > 0))
    assert len(tissue) > 30
    for angle in np.linspace(needle.TIP_ANGLE, -2 * stitch.half - 0.1, 40):
        simulation.pose_needle(poses.flat(stitch.on_arc(angle)))
        mujoco.mj_fwdPosition(model, data)
        near = min(
            mujoco.mj_geomDistance(model, data, a, b, 0.003, None)
            for a in scene.needle_geoms
            for b in tissue
        )
        assert near * 1e3 > clearance, (
            f"{near * 1e3:.2f} mm with the needle's {math.degrees(angle):.0f}° in the entry"
        )
        bodies = model.geom_bodyid[data.contact.geom]
        assert not ((bodies == model.body("needle").id).any(axis=1)).any()


# -- configuration ---------------------------------------------------------------------------------


def test_the_hash_is_that_of_the_configuration():
    first = build_scene(SceneConfig())
    assert build_scene(SceneConfig()) is first
    compose._build_scene.cache_clear()
    assert build_scene(SceneConfig()).hash == first.hash
    others = [{"thread": 10}, {"hole_pair": 2}, {"layout": "3dmed"}, {"grasp": "attach"}]
    assert len({first.hash, *(build_scene(SceneConfig(**other)).hash for other in others)}) == 5


@pytest.mark.parametrize(
    ("field", "wrong", "allowed"),
    [
        ("layout", "simpel", LAYOUTS),
        ("hole_pair", 5, "1234"),
        ("thread", 11, ("0", "10", "20", "40")),
        ("instrument", "400007", INSTRUMENTS),
        ("grasp", "glue", ("friction", "attach")),
    ],
)
def test_wrong_values_are_refused_with_what_is_allowed(field, wrong, allowed):
    with pytest.raises(InputError) as refusal:
        dataclasses.replace(SceneConfig(), **{field: wrong})
    assert str(wrong) in str(refusal.value)
    assert all(str(name) in str(refusal.value) for name in allowed)


def test_named_lists_what_exists():
    scene = build_scene(SceneConfig())
    assert scene.named("camera", "front") == scene.model.camera("front").id
    assert scene.named("body", "needle") == scene.model.body("needle").id
    with pytest.raises(UnknownName, match=r"Did you mean 'needle'\?.*psm1_tip"):
        scene.named("body", "nedle")
    with pytest.raises(SurgicaiError, match=r"actuator.*body.*camera.*geom.*joint.*sensor.*site"):
        scene.named("bone", "needle")


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("thread", [0, 10, 20, 40])
def test_every_layout_and_thread_steps_without_warnings(layout, thread):
    simulation = Simulation(build_scene(SceneConfig(layout=layout, thread=thread)))
    model, data = simulation.model, simulation.data
    assert (
        sum(model.body(index).name.startswith("thread_") for index in range(model.nbody)) == thread
    )
    mujoco.mj_step(model, data, 100)
    assert not warnings_of(data)
    assert np.isfinite(data.qpos).all()
    assert (
        poses.distance(simulation.needle(), (*needle.HOME, *poses.IDENTITY[3:])) < 0.001
    )  # it lies still
