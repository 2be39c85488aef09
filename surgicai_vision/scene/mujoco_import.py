"""Import MuJoCo even where $MUJOCO_GL names an OpenGL library this machine lacks, or no library.

There, `import mujoco` fails although physics needs no OpenGL: PyOpenGL leaves None instead of a
library that it cannot load, and MuJoCo refuses names that it does not know. Packages that import
MuJoCo import this module first. Drawing is refused only when it is requested, with a plain message
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
