"""MuJoCo on a machine that lacks the OpenGL library that $MUJOCO_GL names.

`import mujoco` ends in an AttributeError there, though physics needs no OpenGL: PyOpenGL leaves
None in the place of a library that it cannot load. Packages that import MuJoCo import this module
first; drawing is refused when it is asked for, in plain words (`scene.opengl`).
"""

import os

VARIABLE = "MUJOCO_GL"

try:
    import mujoco
except AttributeError:
    named = os.environ[VARIABLE]
    os.environ[VARIABLE] = "disable"
    try:
        import mujoco  # noqa: F401
    finally:
        os.environ[VARIABLE] = named
