"""`side`: a camera on PSM2's side of the scene, level with the instruments."""

from surgicai_vision.scene.cameras import CameraPose

SIDE = CameraPose(
    position=(-0.11, 0.04, 0.14),
    direction=(0.82, 0.0, -0.57),
    up=(0.57, 0.0, 0.82),
    fovy=0.8,
)
