"""Projection: where a camera's image truly shows the jaws of an arm.

This reads the simulator's state: it labels examples and measures errors, and no policy sees it.
What a robot knows about its cameras is `calibration`.
"""

import numpy as np

from surgicai_vision.envs import poses
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene import cameras
from surgicai_vision.scene.crops import NEAREST


def jaws_in_image(
    simulation: Simulation, camera: str, arm: str, size: tuple[int, int]
) -> tuple[float, float]:
    """Return where a camera's whole image shows the grasp point of an arm's jaws.

    Args:
        simulation: an env's, in the state that is shown; its model has the randomised cameras.
        camera: name of a camera, not of a crop.
        arm: one of `names.ARMS`.
        size: height and width of the image [pixel].

    Returns:
        x and y as shares of the image's width and height, (0, 0) at the upper left corner and (1,
        1) at the lower right one; outside of that, the point is not in the image.
    """
    model = simulation.model
    stand = poses.flat(cameras.extrinsics(model, simulation.data, camera))
    grasp = poses.position(simulation.grasp(arm))
    x, y, z = poses.transform(poses.invert(stand), grasp)
    height, width = size
    depth = max(z, NEAREST)
    seen = np.array([x / depth, y / depth, 1.0])
    across, down, _ = cameras.intrinsics(model, camera, height, width) @ seen
    # K has the centre of the first pixel at 0.
    return (float(across) + 0.5) / width, (float(down) + 0.5) / height
