"""`side`: a camera on PSM2's side of the scene, level with the instruments, and a crop of it."""

from surgicai_vision.core.names import PSM2
from surgicai_vision.scene.cameras import CameraPose, Crop

SIDE = CameraPose(
    position=(-0.11, 0.04, 0.14),
    direction=(0.82, 0.0, -0.57),
    up=(0.57, 0.0, 0.82),
    fovy=0.8,
)
SIDE_PSM2 = Crop("side", PSM2, distance=0.13, span=0.05)
