"""Orbit: a free camera around a point, which a person turns, shifts and zooms."""

import dataclasses
import math
from dataclasses import dataclass

import mujoco

from surgicai_vision.scene.cameras import Vector
from surgicai_vision.scene.crops import CROPPED

NEAREST = 0.02
FARTHEST = 0.6
"""Distances from the point [m]: inside the needle's plane, and with both arms in view."""
STEEPEST = 89.0
"""Largest elevation either way [deg]."""


@dataclass(frozen=True)
class Orbit:
    """A free camera, in MuJoCo's terms.

    Attributes:
        target: the world point in the middle of the image [m].
        distance: from that point [m].
        azimuth: direction of view about world z [deg]; 90 looks along +y.
        elevation: of the direction of view [deg]; -90 looks straight down.
    """

    target: Vector = CROPPED
    distance: float = 0.16
    azimuth: float = -60.0
    elevation: float = -42.0

    def turned(self, right: float, down: float) -> "Orbit":
        """Return the camera after a drag that turns the scene to the right and down [deg]."""
        elevation = min(STEEPEST, max(-STEEPEST, self.elevation - down))
        azimuth = (self.azimuth - right + 180.0) % 360.0 - 180.0
        return dataclasses.replace(self, azimuth=azimuth, elevation=elevation)

    def shifted(self, right: float, down: float) -> "Orbit":
        """Return the camera after a drag that shifts the scene [share of its distance]."""
        azimuth = math.radians(self.azimuth)
        elevation = math.radians(self.elevation)
        sideways = (math.sin(azimuth), -math.cos(azimuth), 0.0)
        upwards = (
            -math.cos(azimuth) * math.sin(elevation),
            -math.sin(azimuth) * math.sin(elevation),
            math.cos(elevation),
        )
        x, y, z = (
            place + self.distance * (down * up - right * side)
            for place, side, up in zip(self.target, sideways, upwards, strict=True)
        )
        return dataclasses.replace(self, target=(x, y, z))

    def zoomed(self, factor: float) -> "Orbit":
        """Return the camera at `factor` times the distance."""
        distance = min(FARTHEST, max(NEAREST, self.distance * factor))
        return dataclasses.replace(self, distance=distance)

    def view(self) -> mujoco.MjvCamera:
        """Return MuJoCo's camera."""
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = self.target
        camera.distance = self.distance
        camera.azimuth = self.azimuth
        camera.elevation = self.elevation
        return camera
