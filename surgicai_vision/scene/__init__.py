"""Scene: two PSMs, a needle, its thread and a phantom as one MuJoCo model, and images of it.

`build_scene(SceneConfig()) -> Scene`; cameras in `scene.cameras`, images in `scene.rendering`, the
arms' kinematics in `scene.kinematics`. See `scene.compose` for the interface.
"""

import surgicai_vision.scene.mujoco_import  # noqa: F401  # before all that imports MuJoCo
from surgicai_vision.scene.compose import ArmIds, Scene, build_scene, build_spec

__all__ = ["ArmIds", "Scene", "build_scene", "build_spec"]
