"""An agent that averages successive images wherever they stand still.

    surgicai-vision evaluate POLICY --detector released:detector --change denoise=6

A camera's pixel noise differs from image to image, and most of a scene does not move: the mean of
the last images has less noise. Where something moves, the newest image is shown alone, so nothing
is smeared. This is motion-adaptive temporal filtering, as in cameras ("3DNR"; Dubois and Sabri,
Noise reduction in image sequences using motion-compensated temporal filtering, IEEE Transactions on
Communications, 1984, without its compensation of motion).

It needs images of a camera that stands still. Crops that lie where the arm reports its jaws move
with them, and so does a camera on the wrist: they are averaged only while the arm waits. With a
detector the filter sees the whole images, before crops are cut from them (`aimed_agent`).
"""

import functools
from collections.abc import Sequence
from typing import final

import cv2
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.corruption import Image
from surgicai_vision.core.lazy import LazyMapping
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    FeatureTable,
    Observation,
    Robot,
    WrappedAgent,
    frame_of,
    image_of,
)

WINDOW = 5
"""Side of the square over which a change is averaged before it counts as motion [px]."""
MOVED = 3.0
"""A change of more than this many times the image's median change is motion."""
LEAST_CHANGE = 2.0
"""Least median change that is assumed [grey levels], for images without noise."""
MARGIN = 3
"""Side of the square around a moved pixel that counts as moved [px]."""


class StillMean:
    """Running mean of the images of one camera, wherever they stand still.

    Args:
        frames: most images that are averaged, at least 1.
    """

    def __init__(self, frames: int):
        self._frames = frames
        self._mean: NDArray[np.float32] | None = None
        self._counts: NDArray[np.float32] = np.zeros((0, 0), np.float32)

    def updated(self, image: Image) -> Image:
        """Return the mean, (height, width, 3), with the next image in it."""
        now = image.astype(np.float32)
        if self._mean is None or self._mean.shape != now.shape:
            self._mean, self._counts = now, np.ones(now.shape[:2], np.float32)
            return image
        change = np.abs(cv2.blur(now - self._mean, (WINDOW, WINDOW))).max(2)
        still = change < MOVED * max(LEAST_CHANGE, float(np.median(change)))
        still = cv2.erode(still.astype(np.uint8), np.ones((MARGIN, MARGIN), np.uint8)) > 0
        counted = np.minimum(self._counts + 1, self._frames)
        self._counts = np.where(still, counted, np.float32(1))
        self._mean = self._mean + (now - self._mean) / self._counts[..., None]
        mean: Image = np.clip(np.rint(self._mean), 0, 255).astype(np.uint8)
        return mean


@final
class DenoisedAgent(WrappedAgent):
    """An agent that sees the running means of its cameras' images; depth stays as it is.

    Args:
        agent: who acts.
        frames: most images that are averaged, at least 1.
    """

    def __init__(self, agent: Agent, frames: int):
        super().__init__(agent)
        self.frames = frames
        self._means: dict[int, dict[str, StillMean]] = {}

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Forget the slot's images."""
        self._forget(slot)
        super().reset(slot, robot, seed)

    def restart(self, slot: int) -> None:
        """Forget the slot's images: another policy may have acted meanwhile."""
        self._forget(slot)
        super().restart(slot)

    def share(self, features: FeatureTable) -> None:
        """Share nothing: features of what this agent sees are its own."""
        return

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the agent's actions (n, 7) on the means."""
        seen = [
            self.averaged(slot, observation)
            for slot, observation in zip(slots, observations, strict=True)
        ]
        return self.agent.act(slots, robots, seen)

    def averaged(self, slot: int, observation: Observation) -> Observation:
        """Return the slot's next observation with each camera's mean in place of its image.

        Every image is read, in every step, also by an agent that would look at some only.
        """
        if not self.cameras:
            return observation
        means = self._means[slot]
        others = {
            key: functools.partial(frame_of, observation, key)
            for key in observation
            if key not in means
        }
        images = {key: mean.updated(image_of(observation, key)) for key, mean in means.items()}
        return LazyMapping(others, images)

    def _forget(self, slot: int) -> None:
        """Forget the slot's images."""
        self._means[slot] = {camera: StillMean(self.frames) for camera in self.cameras}
