"""Corruption: blur, noise and smoke on the images an agent is given.

The env, its rewards and its films stay clean.

A corruption is `change(image, strength, moment) -> image` of (height, width, 3) uint8. It is a
function of the image, the strength, the start seed, the step and the view alone, so an episode
looks the same in any batch and process. At strength 0 the image comes back as it was.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.lazy import LazyMapping
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    FeatureTable,
    Observation,
    Robot,
    frame_of,
)

Image = NDArray[np.uint8]

BLUR = 1 / 56
"""Standard deviation of the blur at strength 1, of the image's height: 4 px at 224."""
NOISE = 64.0
"""Standard deviation of the noise at strength 1 [grey levels of 255]."""
SMOKE_COLOUR = (196.0, 198.0, 202.0)
"""Colour of thick smoke, a cool grey [grey levels of 255]."""
SMOKE_THIN, SMOKE_THICK = 0.4, 0.9
"""Opacity of the smoke at strength 1 where it is thinnest and thickest."""
SMOKE_KNOTS, SMOKE_DRIFT = 5, 1 / 200
"""Clouds across an image, and their way a control step, of its width: a width in 4 s."""


@dataclass(frozen=True)
class Moment:
    """When and where an image was taken: start seed, step in the episode, index of the view."""

    seed: int
    step: int
    view: int


def blur(image: Image, strength: float, moment: Moment) -> Image:
    """Return the image out of focus."""
    import cv2

    sigma = strength * BLUR * image.shape[0]
    if sigma == 0:
        return image
    changed: Image = cv2.GaussianBlur(image, (0, 0), sigma)
    return changed


def noise(image: Image, strength: float, moment: Moment) -> Image:
    """Return the image with Gaussian noise, drawn anew for every image."""
    rng = np.random.default_rng((moment.seed, moment.step, moment.view))
    grain = rng.standard_normal(image.shape, dtype=np.float32)
    return _bytes(image + np.float32(strength * NOISE) * grain)


def smoke(image: Image, strength: float, moment: Moment) -> Image:
    """Return the image behind smoke that drifts; each start and view has clouds of its own."""
    height, width = image.shape[:2]
    field = _clouds(moment.seed, moment.view, height, width)
    field = np.roll(field, round(moment.step * SMOKE_DRIFT * width), axis=1)
    opacity = np.float32(strength) * (SMOKE_THIN + (SMOKE_THICK - SMOKE_THIN) * field)[..., None]
    return _bytes(image + opacity * (np.array(SMOKE_COLOUR, np.float32) - image))


def _clouds(seed: int, view: int, height: int, width: int) -> NDArray[np.float32]:
    """Return smooth noise from 0 to 1, (height, width), that tiles across.

    It is bilinear between random knots.
    """
    knots = np.random.default_rng((seed, view)).random(
        (SMOKE_KNOTS + 1, SMOKE_KNOTS), dtype=np.float32
    )
    rows, columns = np.arange(height) * SMOKE_KNOTS / height, np.arange(width) * SMOKE_KNOTS / width
    row, column = rows.astype(int), columns.astype(int)
    down, right = (rows - row).astype(np.float32)[:, None], (columns - column).astype(np.float32)
    next_column = (column + 1) % SMOKE_KNOTS
    upper = knots[row][:, column] * (1 - right) + knots[row][:, next_column] * right
    lower = knots[row + 1][:, column] * (1 - right) + knots[row + 1][:, next_column] * right
    smooth: NDArray[np.float32] = upper * (1 - down) + lower * down
    return smooth


def _bytes(values: NDArray[np.generic]) -> Image:
    rounded: Image = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return rounded


Change = Callable[[Image, float, Moment], Image]
CORRUPTIONS: Mapping[str, Change] = MappingProxyType({"blur": blur, "noise": noise, "smoke": smoke})


@final
class CorruptedAgent(Agent):
    """An agent that sees through a corruption.

    Args:
        agent: who acts.
        change: one of `CORRUPTIONS`.
        strength: 0 to 1.
    """

    def __init__(self, agent: Agent, change: Change, strength: float):
        self.name = agent.name
        self.cameras = agent.cameras
        self.image_size = agent.image_size
        self.depth = agent.depth
        self.privileged = agent.privileged
        self.action_mode = agent.action_mode
        self._agent = agent
        self._change = change
        self._strength = strength
        self._seeds: dict[int, int] = {}
        self._steps: dict[int, int] = {}

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Count the slot's steps from 0."""
        self._seeds[slot] = seed
        self._steps[slot] = 0
        self._agent.reset(slot, robot, seed)

    def restart(self, slot: int) -> None:
        """Tell the agent behind; the slot's steps count on."""
        self._agent.restart(slot)

    def share(self, features: FeatureTable) -> None:
        """Let the agent behind share features."""
        self._agent.share(features)

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the agent's actions (n, 7) on what it sees."""
        seen = [
            self._seen(slot, observation)
            for slot, observation in zip(slots, observations, strict=True)
        ]
        for slot in slots:
            self._steps[slot] += 1
        return self._agent.act(slots, robots, seen)

    def _seen(self, slot: int, observation: Observation) -> Observation:
        """Return an observation whose images are changed when they are looked at."""
        if not self.cameras:
            return observation
        moments = {
            view: Moment(self._seeds[slot], self._steps[slot], camera_number(view))
            for view in self.cameras
        }

        def changed(view: str) -> Image:
            image = frame_of(observation, view).astype(np.uint8, copy=False)
            return self._change(image, self._strength, moments[view])

        makers = {
            key: functools.partial(changed, key)
            if key in moments
            else functools.partial(frame_of, observation, key)
            for key in observation
        }
        return LazyMapping(makers, {})
