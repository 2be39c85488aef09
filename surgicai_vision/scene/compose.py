"""Compose: a `SceneConfig` becomes one MuJoCo model, through `mujoco.MjSpec`.

Interface: `build_scene(config) -> Scene`, cached per process. `Scene` holds the model, the ids that
later stages need, and the scene hash: sha256 over the compiled XML and the configuration, so any
change of geometry changes the hash.

World: metres, z up, gravity 9.81 m/s². Solver settings are those under which a friction grasp holds
(`benchmarks/grip.py` shows the effect of each): Newton, elliptic cones, impratio 100, Euler, 2 ms.
"""

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import mujoco

from surgicai_vision.core import config as configuration
from surgicai_vision.core import names
from surgicai_vision.core.cameras import other_cameras
from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.errors import UnknownName
from surgicai_vision.scene import arm, holes, kinematics, needle, phantom, rotations, thread, tissue
from surgicai_vision.scene.cameras import add_cameras, crop_of
from surgicai_vision.scene.visual import materials, skin

TIMESTEP = 0.002
USER_DATA = 208
"""How many numbers the envs keep inside MuJoCo's state (goal, progress), so that one vector is the
whole state.
"""

# Collision bits.
SURFACES = 1
"""Needle on tissue."""
GRIP = 2
"""Needle in jaws."""
FIRM = 4
"""Instruments on firm tissue."""
ARMS = 8
"""Instrument on instrument."""
THREAD = 16
"""Thread on tissue and instruments."""


@dataclass(frozen=True)
class ArmIds:
    """Indices of one arm in MuJoCo's arrays."""

    qpos: slice
    finger_qpos: int
    actuators: slice
    jaw_actuator: int
    tip_site: int
    grasp_site: int
    tip_body: int
    pads: tuple[int, int]


@dataclass(frozen=True)
class Scene:
    """A compiled scene.

    Attributes:
        model: the MuJoCo model; shared, so envs without randomisation must not write to it.
        config: what it was built from.
        hash: sha256 (hex) of the compiled XML and the configuration.
        instrument: the PSM instrument.
        arms: arm name → its ids.
        leads: how far a command can usefully be ahead of each joint (`arm.leads`) [rad, the third
            in m].
        pair: the hole pair of this scene's stitch.
        needle_qpos: the needle's position and quaternion in qpos.
        needle_geoms: ids of the needle's capsules, from base to tip.
        ink_geoms: ids of the ink around each hole pair, if each has its own; else empty.
        other_cameras: names of its cameras that are other distributions'.
    """

    model: mujoco.MjModel
    config: SceneConfig
    hash: str
    instrument: kinematics.Instrument
    arms: Mapping[str, ArmIds]
    leads: tuple[float, ...]
    pair: holes.HolePair
    needle_qpos: slice
    needle_geoms: range
    ink_geoms: tuple[int, ...] = ()
    other_cameras: tuple[str, ...] = ()

    def named(self, kind: str, name: str) -> int:
        """Return the id of a named body, joint, geom, site, camera, actuator or sensor.

        Raises:
            UnknownName: listing what exists.
        """
        kinds = {k: getattr(self.model, f"n{k}") for k in ("body", "geom", "site", "sensor")}
        kinds |= {"joint": self.model.njnt, "camera": self.model.ncam, "actuator": self.model.nu}
        if kind not in kinds:
            raise UnknownName("kind of element", kind, kinds)
        look_up = getattr(self.model, kind)
        known = [look_up(index).name for index in range(kinds[kind])]
        if name not in known:
            raise UnknownName(kind, name, known)
        return known.index(name)


def build_scene(config: SceneConfig = SceneConfig()) -> Scene:
    """Return the compiled scene of `config`, the same object as long as no camera is registered.

    The cameras of other distributions come last and are not in the hash: a camera has no mass, so
    everything else in the scene moves and looks the same without them.
    """
    return _build_scene(config, other_cameras())


@functools.lru_cache(maxsize=8)
def _build_scene(config: SceneConfig, others: tuple[str, ...]) -> Scene:
    """Build the scene of `config` with the cameras `others` in addition to ours."""
    spec = build_spec(config)
    model = spec.compile()
    text = spec.to_xml() + configuration.digest(configuration.to_identity(config))
    if config.tissue == "soft":
        text += configuration.digest(tissue.FORCES[config.tissue_forces])
    if others:
        add_cameras(spec, others, config.instrument)
        model = spec.compile()
    free = int(model.joint("needle").qposadr[0])
    first = model.geom("needle_0").id
    return Scene(
        model=model,
        config=config,
        hash=hashlib.sha256(text.encode()).hexdigest(),
        instrument=kinematics.INSTRUMENTS[config.instrument],
        arms=MappingProxyType({name: _arm_ids(model, name) for name in names.ARMS}),
        leads=arm.leads(config.torque),
        pair=holes.PAIRS[config.layout][config.hole_pair - 1],
        needle_qpos=slice(free, free + 7),
        needle_geoms=range(first, first + needle.SEGMENTS),
        ink_geoms=skin.ink_geoms(model, config.layout) if config.ink == "due" else (),
        other_cameras=tuple(name for name in others if crop_of(name) is None),
    )


def build_spec(config: SceneConfig) -> mujoco.MjSpec:
    """Return the scene as an editable `mujoco.MjSpec`."""
    spec = mujoco.MjSpec()
    spec.modelname = "surgicai-vision"
    _set_options(spec, config.thread)
    materials.add_materials(spec)
    materials.add_surroundings(spec)
    soft = {"contype": 0, "conaffinity": SURFACES | THREAD}
    phantom.add_table(spec, soft)
    is_soft = config.tissue == "soft"
    phantom.add_phantom(
        spec,
        config.layout,
        needle=soft,
        arm={"contype": 0, "conaffinity": FIRM},
        ridge={"contype": 0, "conaffinity": FIRM | THREAD | (0 if is_soft else SURFACES)},
        is_solid=is_soft,
    )
    body = needle.add_needle(spec, {"contype": SURFACES | GRIP, "conaffinity": 0})
    thread.add_thread(
        spec,
        body,
        needle.point(0.0).tolist(),
        config.thread,
        {"contype": THREAD, "conaffinity": 0},
        thread.HELD_ARMATURE if is_soft else thread.ARMATURE,
    )
    if is_soft:
        spec.nuserdata += tissue.SOFT_DATA
        forces = tissue.FORCES[config.tissue_forces]
        skin = {"contype": 0, "conaffinity": SURFACES}
        tissue.add_soft_tissue(spec, config.layout, forces, config.thread, skin)
    for name in names.ARMS:
        _add_arm(spec, config, name)
    if config.grasp == "attach":
        for name in names.ARMS:
            arm.add_weld(spec, name)
    materials.dress(spec, config)
    add_cameras(spec, names.CAMERAS, config.instrument)
    return spec


def _add_arm(spec: mujoco.MjSpec, config: SceneConfig, name: str) -> None:
    """Add one arm at its base pose."""
    pose = kinematics.base_in_world(name)
    quat = rotations.matrix_to_quaternion(pose[:3, :3])
    base = spec.worldbody.add_body(
        name=f"{name}_base", pos=pose[:3, 3].tolist(), quat=quat.tolist()
    )
    touching = {names.PSM1: (FIRM | ARMS, GRIP | THREAD), names.PSM2: (FIRM, GRIP | THREAD | ARMS)}[
        name
    ]
    bits = {"contype": touching[0], "conaffinity": touching[1]}
    instrument = kinematics.INSTRUMENTS[config.instrument]
    arm.add_arm(spec, name, base, instrument, config.torque, bits)


def _set_options(spec: mujoco.MjSpec, thread: int) -> None:
    """Set the solver, the visual ranges and the size of the user data.

    Joint damping is explicit. MuJoCo's Euler would apply it implicitly, after the contact solver.
    The accelerations that start the next solution would then not be those of the last one: the
    solver takes 2.4 iterations instead of 1.3, and once in some thousand steps it ends far off and
    kicks the held needle (`benchmarks/grip.py`: 4.6° in the worst of 40 trials, 0.9° without). A
    thread forms one island with everything it touches, so solving without islands and with a sparse
    Jacobian saves 15 % of a step.
    """
    option = spec.option
    option.timestep = TIMESTEP
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.impratio = 100.0
    option.iterations = 50
    option.tolerance = 1e-10
    option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    if thread:
        option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    spec.nuserdata = USER_DATA
    spec.stat.extent = 0.1
    spec.stat.center = [0.0, 0.044, 0.08]
    spec.visual.map.znear = 0.02
    spec.visual.map.zfar = 20.0
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960
    spec.compiler.degree = False
    spec.compiler.autolimits = True


def _arm_ids(model: mujoco.MjModel, name: str) -> ArmIds:
    first = model.joint(f"{name}_{kinematics.DVRK_JOINTS[0]}").qposadr[0]
    servo = model.actuator(f"{name}_{kinematics.DVRK_JOINTS[0]}").id
    return ArmIds(
        qpos=slice(first, first + 6),
        finger_qpos=int(model.joint(f"{name}_left_finger").qposadr[0]),
        actuators=slice(servo, servo + 6),
        jaw_actuator=model.actuator(f"{name}_jaw").id,
        tip_site=model.site(f"{name}_tip").id,
        grasp_site=model.site(f"{name}_grasp").id,
        tip_body=model.body(f"{name}_tip").id,
        pads=(model.geom(f"{name}_left_pad").id, model.geom(f"{name}_right_pad").id),
    )
