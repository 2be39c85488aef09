"""Soft tissue's elements and forces: springs are as stiff as requested, yielding is permanent."""

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig
from surgicai_vision.envs import tissue as tissue_in_envs
from surgicai_vision.scene import tissue
from surgicai_vision.scene.compose import FIRM, SURFACES, THREAD, build_scene
from surgicai_vision.scene.holes import PAIRS

SOFT = SceneConfig(tissue="soft", thread=10)
PHANTOM = tissue.FORCES["phantom"]


def test_every_name_has_forces_that_are_in_order():
    assert set(tissue.FORCES) == set(names.TISSUE_FORCES)
    for forces in tissue.FORCES.values():
        assert all(value > 0.0 for value in dataclasses.astuple(forces))
        assert forces.yield_force < forces.tear_force
        assert 0.0 < forces.dent_in < tissue.THICKNESS / 2, "pierced before the skin stiffens"


def test_each_preset_is_a_scene_of_its_own():
    scenes = {build_scene(SceneConfig(tissue="soft", tissue_forces=f)).hash for f in tissue.FORCES}
    assert len(scenes | {build_scene(SceneConfig()).hash}) == 4


def test_tissue_with_channels_has_none_of_it():
    model = build_scene(SceneConfig(thread=10)).model
    every = [model.body(index).name for index in range(model.nbody)]
    assert not [name for name in every if name.startswith(("carrier", "hold", "thread_hold"))]


def test_the_user_data_hold_a_packed_tissue():
    assert tissue_in_envs.SIZE <= tissue.SOFT_DATA


@pytest.mark.parametrize("layout", PAIRS)
def test_the_ridge_is_solid(layout):
    """Along every hole's axis the needle, the jaws and the thread meet tissue at the plane."""
    model = build_scene(SceneConfig(layout=layout, tissue="soft", thread=10)).model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for bits in (SURFACES, FIRM, THREAD):
        model.geom_group[:] = np.where(model.geom_conaffinity & bits, 5, 0)
        for pair in PAIRS[layout]:
            for hole in (pair.entry, pair.exit):
                normal = np.array(hole.normal)
                start = np.array(hole.centre) + 0.01 * normal
                found = np.zeros(1, np.int32)
                group = np.array([0, 0, 0, 0, 0, 1], np.uint8)
                distance = mujoco.mj_ray(model, data, start, -normal, group, 1, -1, found)
                assert distance == pytest.approx(0.01, abs=1e-6)


def test_only_the_needle_meets_the_skin():
    model = build_scene(SOFT).model
    for piece in (1, 2, 3, 4):
        for side in ("entry", "exit"):
            assert model.geom(tissue.skin_name(side, piece)).conaffinity == SURFACES
            assert model.geom(f"phantom_{side}{piece}").conaffinity == FIRM | THREAD


# -- springs ---------------------------------------------------------------------------------------


def weight_on_a_spring(stiffness, mass):
    """Return how far [m] a weight of `mass` [kg] at rest stretches a hold of `stiffness` [N/m]."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    body = spec.worldbody.add_body(name="weight")
    body.add_joint(type=mujoco.mjtJoint.mjJNT_FREE)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.001, 0, 0], mass=mass)
    spec.worldbody.add_body(name="anchor", mocap=True)
    equality = spec.add_equality(
        name="hold", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY
    )
    equality.name1, equality.name2 = "weight", "anchor"
    equality.data[:6] = [0.0] * 6
    model = spec.compile()
    solref, solimp = tissue.spring(stiffness, float(model.body_invweight0[1, 0]))
    model.eq_solref[0], model.eq_solimp[0] = solref, solimp
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1000)
    return -float(data.qpos[2])


@pytest.mark.parametrize("stiffness", [200.0, 500.0, 800.0, 1500.0])
@pytest.mark.parametrize("mass", [2e-5, 2e-4, 2e-2])
def test_a_spring_is_as_stiff_as_asked_for(stiffness, mass):
    """The explicit spring of 500 N/m on 0.02 g would diverge at 2 ms; this one does not."""
    assert weight_on_a_spring(stiffness, mass) == pytest.approx(mass * 9.81 / stiffness, rel=0.02)


def test_skin_stiffens_only_where_no_tip_goes_through():
    (stiff, _), (shallow, deep, width, _, power) = tissue.skin_spring(1500.0, 5000.0)
    _, (plain, *_) = tissue.spring(1500.0, 5000.0)
    assert shallow == plain
    assert (1 - shallow) / (1 - deep) == pytest.approx(tissue.STIFFENING, rel=0.02)
    assert width == tissue.THICKNESS
    assert power > 1.0
    assert -stiff * deep < 250000.0, "stable at 2 ms"


# -- yield and tear --------------------------------------------------------------------------------

DISTANCES = st.floats(1e-6, 0.02)


@given(DISTANCES, st.floats(0.0, 0.003))
def test_what_gives_way_moves_towards_what_pulls(distance, yielded):
    share, stayed, is_torn = PHANTOM.give_way(distance, yielded)
    assert 0.0 <= share < 1.0
    assert is_torn or stayed - yielded == pytest.approx(share * distance, abs=1e-12)
    assert is_torn == (PHANTOM.lateral_stiffness * distance > max(PHANTOM.tear_force, 1e-9)) or (
        share == 0.0
    )


@given(DISTANCES, st.floats(0.0, 0.003))
def test_after_it_gave_way_it_gives_way_no_more(distance, yielded):
    share, stayed, is_torn = PHANTOM.give_way(distance, yielded)
    left = distance * (1.0 - share)
    again, same, torn_again = PHANTOM.give_way(left, stayed)
    assert again * left < 1e-9
    assert not torn_again
    assert same == pytest.approx(stayed, abs=1e-9)
    if is_torn:
        assert PHANTOM.lateral_stiffness * left == pytest.approx(PHANTOM.yield_force)


def test_below_the_yield_force_nothing_stays():
    elastic = PHANTOM.yield_force / PHANTOM.lateral_stiffness
    assert PHANTOM.give_way(0.999 * elastic, 0.0) == (0.0, 0.0, False)


def test_pulled_slowly_it_hardens_until_it_tears():
    """Force over displacement: elastic, then half as stiff (hardening equals stiffness), a tear."""
    assert PHANTOM.hardening == PHANTOM.lateral_stiffness
    elastic = PHANTOM.yield_force / PHANTOM.lateral_stiffness
    torn = elastic + 2 * (PHANTOM.tear_force - PHANTOM.yield_force) / PHANTOM.lateral_stiffness
    anchor = yielded = 0.0
    forces = []
    for way in np.arange(1e-5, 2 * torn, 1e-5):
        share, yielded, is_torn = PHANTOM.give_way(way - anchor, yielded)
        anchor += share * (way - anchor)
        forces.append(PHANTOM.lateral_stiffness * (way - anchor))
        if is_torn:
            break
    assert way == pytest.approx(torn, rel=0.01)
    assert max(forces) == pytest.approx(PHANTOM.tear_force, rel=0.01)
    assert forces[-1] == pytest.approx(PHANTOM.yield_force, rel=0.01)
    assert forces[round(elastic / 1e-5) - 1] == pytest.approx(PHANTOM.yield_force, rel=0.01)
