"""Aimed calibration: crops about the jaws as they are, as a detector aims them.

    env.place_crops_by(AimedCalibration(env.simulation, seed))

To train on what a policy sees whose crops a detector aims (docs/detection.md), no detector need
look at the demonstrations: the simulator knows where a camera really shows the jaws. A crop lies
there, off by about as much as the released detector is. Its scale is that of the nominal
calibration, as at an evaluation. K and T_world_camera stay nominal.
"""

import zlib

import numpy as np

from surgicai_vision.core.cameras import camera_number
from surgicai_vision.envs.calibration import Calibration
from surgicai_vision.envs.projection import jaws_in_image
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene.cameras import Crop, Window
from surgicai_vision.scene.crops import whole_size, window_at

ERROR = 0.00067
"""Standard deviation of a crop's place along each of its sides, at the depth of the holes [m]. The
median distance is then 0.8 mm, that of the released detector (`benchmarks/detector_error.py`)."""


class AimedCalibration(Calibration):
    """The nominal calibration, but for the place of crops; see the module's docstring.

    Args:
        simulation: the env's.
        seed: with the state and the view, it decides how far a crop is off.
    """

    def __init__(self, simulation: Simulation, seed: int):
        super().__init__(simulation)
        self._seed = seed

    def _window_of(self, crop: Crop, view: str, size: tuple[int, int]) -> Window:
        """Return where a view that is a crop lies: about the jaws as a detector would see them."""
        height, width = size
        whole, across = whole_size(crop, self._fovy(crop.camera), height, width)
        x, y = jaws_in_image(self._simulation, crop.camera, crop.arm, (whole, across))
        right, down = (error * height / crop.span for error in self._error(view))
        left = x * across - width / 2.0 + right
        top = y * whole - height / 2.0 + down
        return window_at(left, top, size, (whole, across))

    def _error(self, view: str) -> tuple[float, float]:
        """Return how far to the right and down a crop is off at the present state [m]."""
        state = zlib.crc32(self._simulation.data.qpos.tobytes())
        generator = np.random.default_rng((self._seed, state, camera_number(view)))
        right, down = generator.normal(0.0, ERROR, 2).tolist()
        return right, down
