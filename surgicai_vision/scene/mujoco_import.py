"""MuJoCo where $MUJOCO_GL names a library of OpenGL that this machine lacks, or none at all.

`import mujoco` ends in an error there, though physics needs no OpenGL: PyOpenGL leaves None in the
place of a library that it cannot load, and MuJoCo refuses names that it does not know. Packages
that import MuJoCo import this module first; drawing is refused when it is asked for, in plain words
(`scene.opengl`).
"""

import os

VARIABLE = "MUJOCO_GL"

try:
    import mujoco
except (AttributeError, ImportError, RuntimeError):
    if VARIABLE not in os.environ:
        raise
    named = os.environ[VARIABLE]
    os.environ[VARIABLE] = "disable"
    try:
        import mujoco  # noqa: F401
    finally:
        os.environ[VARIABLE] = named
