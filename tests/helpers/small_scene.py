"""A tiny scene with the names of the real one, for tests of cameras and rendering alone."""

import mujoco

PLANE_DISTANCE = 0.1234
BALL_RADIUS = 0.002
BOX = mujoco.mjtGeom.mjGEOM_BOX
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE


def small_spec() -> mujoco.MjSpec:
    """Return a wall 123.4 mm in front of the camera "front", a ball as needle, and two arms."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.stat.extent, spec.stat.center = 0.1, [0.0, 0.0, 0.0]
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 20.0
    wall = spec.worldbody.add_body(name="phantom", pos=[0.0, 0.0, -PLANE_DISTANCE - 0.01])
    wall.add_geom(type=BOX, size=[0.04, 0.04, 0.01], rgba=[0.8, 0.4, 0.4, 1.0])
    needle = spec.worldbody.add_body(name="needle", pos=[0.01, 0.005, -0.08])
    needle.add_freejoint()
    needle.add_geom(type=SPHERE, size=[BALL_RADIUS, 0, 0])
    thread = needle.add_body(name="thread_0", pos=[0.0, 0.02, 0.0])
    thread.add_geom(type=SPHERE, size=[BALL_RADIUS, 0, 0])
    for name, x in (("psm1", -0.02), ("psm2", 0.03)):
        base = spec.worldbody.add_body(name=f"{name}_base", pos=[x, -0.01, -0.08])
        finger = base.add_body(name=f"{name}_left_finger")
        finger.add_geom(type=SPHERE, size=[BALL_RADIUS, 0, 0])
    spec.worldbody.add_geom(type=SPHERE, size=[BALL_RADIUS, 0, 0], pos=[0.0, -0.02, -0.08])
    spec.worldbody.add_camera(name="front", fovy=50.0)
    spec.worldbody.add_camera(
        name="back", pos=[0.05, 0.03, 0.02], xyaxes=[0.8, 0.0, -0.6, 0.1, 1.0, 0.0], fovy=60.0
    )
    return spec
