"""Arm: one da Vinci PSM as a MuJoCo kinematic tree, built from the same DH table as `kinematics`.

Bodies follow the modified DH frames. The last one, `tip`, is on the wrist-yaw axis, with +z along
the jaws, ±y the direction in which they open, and x along their hinge. The jaws' grasp point lies
`GRASP_DEPTH` along z.

Actuators are gravity-compensated position servos with the natural frequency `BANDWIDTH` on each
joint's own inertia. The joints follow a commanded pose as a dVRK's do, and yield to contact because
their stiffness is finite and their torque limited (`TORQUES`). The two fingers are coupled by an
equality, so one torque-limited motor closes both (about 10 N each). Numbers without another source
were measured by `benchmarks/grip.py`.
"""

import math
from types import MappingProxyType

import mujoco

from surgicai_vision.scene.kinematics import DVRK_JOINTS, Instrument
from surgicai_vision.scene.needle import BODY_RADIUS, CONTACT

GRASP_DEPTH = 0.010
"""Grasp point beyond the wrist-yaw axis [m] (SurgicAI)."""
PAD_END = 0.0125
"""End of the jaw pads beyond the wrist-yaw axis [m]: 2.5 mm past the grasp point."""
PAD_WIDTH = 0.003
PAD_THICKNESS = 0.0010
PAD_OFFSET = BODY_RADIUS - 0.00005
"""Inner faces of the closed jaws from their middle plane [m]; parallel when they hold a needle."""
JAW_LIMITS = (-0.06, 1.0)
"""Angle of each finger [rad]; below 0 only when the jaws close on nothing."""
JAW_GAIN = 1.0
"""Gain of the servo of the coupled fingers [N·m/rad]."""
JAW_TORQUE = 0.2
"""Largest torque of that servo [N·m]: 10 N at each pad. Grips of EndoWrist instruments were
measured at 2.3 to 39.9 N (Journal of Endourology 25:523, 2011). Below 0.1 N·m, a needle that meets
tissue turns in the jaws (`docs/tissue.md`)."""
JAW_ARMATURE = 1e-4
"""[kg·m²]: gives the servo a natural frequency of 70 rad/s. With an armature of 1e-5 (220 rad/s)
the closing jaws struck the needle at 12 rad/s, so the pads moved 0.25 mm in one physics step. With
friction drawn 15 % lower, the needle then shot out of them in one of three grasps."""
SHAFT_RADIUS = 0.004
SHAFT_LENGTH = 0.36
WRIST_RADIUS = 0.003
BANDWIDTH = 100.0
"""[rad/s]"""
TORQUES = MappingProxyType(
    {
        "dvrk": (3.32, 3.32, 9.88, 0.344, 0.344, 0.344),
        "effective": (0.7, 0.7, 5.0, 0.08, 0.06, 0.06),
    }
)
"""Preset → largest torque of the six servos [N·m, the third in N].

"dvrk" is what the motors can deliver: current × gear ratio × torque constant, computed by
`compute-ftmax.py` of the dVRK's software (sawIntuitiveResearchKit). "effective" is our choice: the
arm presses with at most about 10 N, as a surgeon who feels the tissue would allow. The expert needs
at most 0.46, 0.39 N·m, 1.85 N, 0.027, 0.010, 0.023 N·m (`benchmarks/press.py` measures the
force)."""
FASTEST = (1.6, 1.6, 0.13, 6.0, 6.0, 6.0)
"""Highest speed at which an action moves a joint [rad/s, the third in m/s]: 1.5 mm along each axis
and 3° about each in 20 ms, the largest step preset, at 80 mm from the remote centre."""
LIMIT_SOLREF = [0.004, 1.0]
LIMIT_SOLIMP = [0.99, 0.999, 0.0001, 0.5, 2.0]
"""For joint limits and the fingers' coupling; the weld takes the solref. A servo commanded 0.5 rad
past a limit rests within 0.1 mrad of it; with MuJoCo's default it rested 83 mrad beyond."""
WELD_SOLIMP = [0.999, 0.9999, 0.0001, 0.5, 2.0]
WELD_TORQUE_SCALE = 0.1
"""[m]. With this, a needle squeezed with 10 N by frictionless jaws turns by at most 0.5° in 1 s of
motion; with the impedance of the joint limits and 0.01 m it turned by 9° to 130°."""
ARMATURE = (0.02, 0.02, 0.5, 2e-4, 1e-4, 1e-4)
MASSES = (0.01, 0.01, 0.05, 0.005, 0.005, 0.004)
"""Link masses [kg]; small compared with the armature, which represents the geared motors."""


def add_arm(
    spec: mujoco.MjSpec,
    arm: str,
    base: mujoco.MjsBody,
    instrument: Instrument,
    torque: str,
    bits: dict[str, int],
) -> None:
    """Add the arm `arm` to `spec` below its base body.

    Args:
        spec: the scene; gets joints and actuators named `{arm}_…`.
        arm: "psm1" or "psm2".
        base: the body at the remote centre of motion, in the arm's base frame.
        instrument: lengths and joint limits.
        torque: key of `TORQUES`.
        bits: collision bits of the instrument.
    """
    body = base
    # The six links of the DH table, with the physical shape of shaft and wrist.
    for index, name in enumerate(DVRK_JOINTS):
        body = _add_link(body, arm, name, index, instrument)
        _add_servo(spec, f"{arm}_{name}", index, TORQUES[torque][index])
        if index == 3:
            _capsule(
                body, f"{arm}_shaft", [0, 0, -SHAFT_LENGTH, 0, 0, -SHAFT_RADIUS], SHAFT_RADIUS, bits
            )
        if index == 4:
            _capsule(
                body, f"{arm}_wrist", [0, 0, 0, instrument.pitch_to_yaw, 0, 0], WRIST_RADIUS, bits
            )
    # The jaws: tip and grasp frames, two coupled fingers.
    tip = body.add_body(
        name=f"{arm}_tip", quat=_frame(instrument.dh[6].alpha, instrument.dh[6].offset)
    )
    tip.add_site(name=f"{arm}_tip", size=[0.0005] * 3, group=4)
    tip.add_site(name=f"{arm}_grasp", pos=[0, 0, GRASP_DEPTH], size=[0.0005] * 3, group=4)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        _add_finger(tip, f"{arm}_{side}", sign, bits)
    _couple_fingers(spec, arm)


def _frame(alpha: float, offset: float) -> list[float]:
    """Return the quaternion (wxyz) of RotX(alpha)·RotZ(offset)."""
    ca = math.cos(alpha / 2)
    sa = math.sin(alpha / 2)
    co = math.cos(offset / 2)
    so = math.sin(offset / 2)
    return [ca * co, sa * co, -sa * so, ca * so]


def _add_link(
    parent: mujoco.MjsBody, arm: str, name: str, index: int, instrument: Instrument
) -> mujoco.MjsBody:
    """Add the body and the joint of one row of the DH table."""
    row = instrument.dh[index]
    body = parent.add_body(
        name=f"{arm}_{name}_link",
        pos=[row.a, -row.d * math.sin(row.alpha), row.d * math.cos(row.alpha)],
        quat=_frame(row.alpha, row.offset),
    )
    body.gravcomp = 1.0
    body.mass = MASSES[index]
    body.inertia = [MASSES[index] * 1e-4] * 3
    body.explicitinertial = True
    body.add_joint(
        name=f"{arm}_{name}",
        type=mujoco.mjtJoint.mjJNT_SLIDE if row.prismatic else mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, 1],
        range=list(instrument.limits[index]),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        armature=ARMATURE[index],
        solref_limit=LIMIT_SOLREF,
        solimp_limit=LIMIT_SOLIMP,
    )
    return body


def _add_servo(spec: mujoco.MjSpec, joint: str, index: int, torque: float) -> None:
    """Add a position servo with natural frequency `BANDWIDTH`, critically damped.

    It gives at most `torque` [N·m or N].
    """
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=ARMATURE[index] * BANDWIDTH**2, kv=2 * ARMATURE[index] * BANDWIDTH)
    actuator.forcelimited = True
    actuator.forcerange = [-torque, torque]


def leads(torque: str) -> tuple[float, ...]:
    """Return how far a command can usefully be ahead of each joint [rad, the third in m].

    There the servo gives its largest torque even while the joint moves as fast as any action does.
    """
    return tuple(
        limit / (armature * BANDWIDTH**2) + 2.0 * speed / BANDWIDTH
        for limit, armature, speed in zip(TORQUES[torque], ARMATURE, FASTEST, strict=True)
    )


def _capsule(
    body: mujoco.MjsBody, name: str, fromto: list[float], radius: float, bits: dict[str, int]
) -> None:
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=fromto,
        size=[radius, 0, 0],
        material="steel",
        mass=0,
        **bits,
    )


def _add_finger(tip: mujoco.MjsBody, name: str, side: float, bits: dict[str, int]) -> None:
    """Add one finger: its hinge opens towards +y (side = 1) or -y (side = -1)."""
    body = tip.add_body(name=f"{name}_finger")
    body.gravcomp = 1.0
    body.mass = 0.001
    body.inertia = [1e-7] * 3
    body.explicitinertial = True
    body.ipos = [0.0, 0.0, 0.006]
    body.add_joint(
        name=f"{name}_finger",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[-side, 0, 0],
        range=list(JAW_LIMITS),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        armature=JAW_ARMATURE,
    )
    start = 0.0045
    body.add_geom(
        name=f"{name}_pad",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, side * (PAD_OFFSET + PAD_THICKNESS / 2), (start + PAD_END) / 2],
        size=[PAD_WIDTH / 2, PAD_THICKNESS / 2, (PAD_END - start) / 2],
        material="jaw",
        mass=0,
        **CONTACT,
        **bits,
    )


def _couple_fingers(spec: mujoco.MjSpec, arm: str) -> None:
    """Tie the right finger's angle to the left one's, and drive both with one motor."""
    equality = spec.add_equality(name=f"{arm}_fingers", type=mujoco.mjtEq.mjEQ_JOINT)
    equality.name1 = f"{arm}_right_finger"
    equality.name2 = f"{arm}_left_finger"
    equality.data[:5] = [0, 1, 0, 0, 0]
    equality.solref = LIMIT_SOLREF
    equality.solimp = LIMIT_SOLIMP
    actuator = spec.add_actuator(
        name=f"{arm}_jaw", target=f"{arm}_left_finger", trntype=mujoco.mjtTrn.mjTRN_JOINT
    )
    actuator.set_to_position(kp=JAW_GAIN, kv=2 * math.sqrt(2 * JAW_GAIN * JAW_ARMATURE))
    actuator.forcelimited = True
    actuator.forcerange = [-JAW_TORQUE, JAW_TORQUE]


def add_weld(spec: mujoco.MjSpec, arm: str) -> None:
    """Add the weld between an arm's tip and the needle, inactive, for grasp level "attach"."""
    weld = spec.add_equality(
        name=f"{arm}_attach", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY
    )
    weld.name1 = f"{arm}_tip"
    weld.name2 = "needle"
    weld.active = False
    # Anchor, pose in the jaws, torque scale [m].
    weld.data[:11] = [*[0.0] * 6, 1.0, 0.0, 0.0, 0.0, WELD_TORQUE_SCALE]
    weld.solref = LIMIT_SOLREF
    weld.solimp = WELD_SOLIMP
