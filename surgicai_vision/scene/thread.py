"""Thread: a chain of capsules on ball joints, tied to the needle's base.

Sources: 95 mm long and 0.372 mm thick in SurgicAI's scene (40 capsules). With fewer segments the
length is the same. Contact is frictionless, with priority over what the thread touches, and the
joints carry an armature: with friction the solver ran eight times slower.
"""

import mujoco

LENGTH = 0.095
RADIUS = 0.000186
MASS = 0.0002
STIFFNESS = 2e-6
DAMPING = 2e-7
ARMATURE = 1e-8
HELD_ARMATURE = 4e-8
"""[kg·m²] of a thread that soft tissue holds. A thread under tension swings faster the lighter it
is. With 1e-8 a thread of 20 segments drawn taut through two stitches ended in a physics error; with
4e-8 even one of 40 does not."""


def add_thread(
    spec: mujoco.MjSpec,
    needle: mujoco.MjsBody,
    base: list[float],
    segments: int,
    bits: dict[str, int],
    armature: float = ARMATURE,
) -> None:
    """Tie a thread of `segments` capsules to `needle`.

    Args:
        spec: the scene.
        needle: the needle's body.
        base: the needle's base in its frame [m]; the thread starts along -y, away from the tip.
        segments: number of capsules, 0 for no thread.
        bits: collision bits of the thread.
        armature: of its joints [kg·m²].
    """
    pitch = LENGTH / max(segments, 1)
    parent = needle
    start = base
    flat = [0.7071067811865476, 0.7071067811865476, 0.0, 0.0]
    for index in range(segments):
        body = parent.add_body(name=f"thread_{index}", pos=start, quat=flat)
        body.add_joint(
            name=f"thread_{index}",
            type=mujoco.mjtJoint.mjJNT_BALL,
            stiffness=STIFFNESS,
            damping=DAMPING,
            armature=armature,
        )
        body.add_geom(
            name=f"thread_{index}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, 0, 0, pitch],
            size=[RADIUS, 0, 0],
            mass=MASS / segments,
            material="thread",
            condim=1,
            priority=2,
            **bits,
        )
        parent = body
        start = [0.0, 0.0, pitch]
        flat = [1.0, 0.0, 0.0, 0.0]
