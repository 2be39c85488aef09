"""Occlusion sensitivity: which parts of its images a policy's action depends on.

    found = occlusion(agent, config, seed=20000, steps=(0, 20, 40), patch=32)
    found.sheet("title")           # a matplotlib figure: each image, and what mattered in it

A policy acts in one episode. At the chosen steps, one square of one image at a time is covered with
the image's mean colour. The measure is how far this moves the action (Zeiler and Fergus, ECCV
2014): the Euclidean distance in units of an action's range. Squares lie half a side apart; a
pixel's sensitivity is the mean over the squares that hide it.

Each covered image is shown to a separate slot that has seen everything the acting one has, so a
policy with memory answers as it would in the episode.

Where a detector aims the crops (`aimed_agent`), the squares lie in the crops that it cut: the
detector sees whole images, without squares.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation.agent import Agent, Env, FeatureTable, Observation
from surgicai_vision.evaluation.aimed_agent import AimedAgent
from surgicai_vision.evaluation.denoised_agent import DenoisedAgent
from surgicai_vision.evaluation.slot import env_of
from surgicai_vision.scene.rendering import Frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Image = NDArray[np.uint8]
HOT = (255.0, 32.0, 0.0)
"""Colour of what matters [grey levels of 255]."""
COVER = 0.75
"""Opacity of that colour on a sheet where the change is largest."""


@dataclass(frozen=True)
class Sensitivity:
    """One image and what mattered in it.

    Attributes:
        step: control step.
        view: the camera or the crop.
        image: what the policy saw, (height, width, 3).
        change: change of the action where a pixel is hidden, (height, width), in units of an
            action's range.
    """

    step: int
    view: str
    image: Image
    change: NDArray[np.float64]


@dataclass(frozen=True)
class Occlusion:
    """The images of one episode at the chosen steps, and how it ended.

    Attributes:
        found: the images step by step, all views of each step.
        success: whether the episode succeeded.
        steps: control steps it took.
    """

    found: tuple[Sensitivity, ...]
    success: bool
    steps: int

    @property
    def largest(self) -> float:
        """Return the largest change of all images, at which the colour is full."""
        return max(float(one.change.max()) for one in self.found)

    def sheet(self, title: str) -> "Figure":
        """Return a grid with one row per step: each view's image and, next to it, what mattered."""
        rows = []
        views = list(dict.fromkeys(one.view for one in self.found))
        for step in dict.fromkeys(one.step for one in self.found):
            images = []
            for one in (one for one in self.found if one.step == step):
                images += [one.image, overlaid(one, self.largest)]
            rows.append((f"step {step}", images))
        columns = [
            text for view in views for text in (view, f"up to {self._most(view):.2f} of the range")
        ]
        return contact_sheet.sheet(rows, columns, title)

    def _most(self, view: str) -> float:
        return max(float(one.change.max()) for one in self.found if one.view == view)


def overlaid(one: Sensitivity, largest: float) -> Image:
    """Return the image with what mattered in colour, full at a change of `largest`."""
    share = COVER * one.change / max(largest, 1e-9)
    mixed = one.image + share[..., None] * (np.array(HOT) - one.image)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)


def occlusion(
    agent: Agent, config: TaskConfig, seed: int, steps: Sequence[int], patch: int
) -> Occlusion:
    """Run one episode of `agent` and hide parts of its images at the chosen steps.

    Args:
        agent: the policy of one subtask.
        config: the task.
        seed: of the start.
        steps: control steps, from 0; those after the episode's end are left out.
        patch: side of the hidden square [px].

    Raises:
        InputError: a policy without images or of the whole procedure, no step within the episode,
            or a square that does not fit into the image.
    """
    still = agent if isinstance(agent, DenoisedAgent) else None
    agent = still.agent if still else agent
    aim = agent if isinstance(agent, AimedAgent) else None
    agent = aim.agent if aim else agent
    _check(agent, config, steps, patch)
    env = env_of(aim or agent, config)
    places = squares(agent.image_size, round(agent.image_size * agent.aspect), patch)
    hidden = [(view, place) for view in agent.cameras for place in places]
    wanted = sorted(set(steps))
    asked = {
        step: range(1 + index * len(hidden), 1 + (index + 1) * len(hidden))
        for index, step in enumerate(wanted)
    }
    features: FeatureTable = {}
    agent.share(features)
    observation, info = env.reset(seed=seed)
    if still:
        still.reset(0, env, seed)
    for slot in range(1 + len(wanted) * len(hidden)):
        agent.reset(slot, env, seed)
    found: list[Sensitivity] = []
    taken = 0
    ended = False
    while not ended:
        features.clear()
        whole = still.averaged(0, observation) if still else observation
        seen = _drawn(aim.crops(whole) if aim else whole)
        now = asked.pop(taken, range(0))
        later = [slot for slots in asked.values() for slot in slots]
        others = [_without(seen, view, place) for view, place in hidden] if now else []
        answers = _act(agent, [0, *now, *later], env, [seen, *others, *[seen] * len(later)])
        if now:
            change = np.linalg.norm(answers[1 : 1 + len(now)] - answers[0], axis=1)
            for index, view in enumerate(agent.cameras):
                mine = change[index * len(places) : (index + 1) * len(places)]
                image = np.asarray(seen[view], np.uint8)
                found.append(Sensitivity(taken, view, image, spread(image, places, mine)))
        observation, _, terminated, truncated, info = env.step(answers[0])
        taken += 1
        ended = terminated or truncated
    env.close()
    if not found:
        raise InputError(f"The episode ended after {taken} steps; give a step before that.")
    return Occlusion(tuple(found), bool(info["is_success"]), taken)


def _check(agent: Agent, config: TaskConfig, steps: Sequence[int], patch: int) -> None:
    """Refuse policies, steps and squares that give no result."""
    if not agent.cameras or agent.depth:
        raise InputError(f"{agent.name} sees no images in colour; give a policy that does.")
    if config.task == names.SUTURE:
        raise InputError(
            f"{agent.name} does the whole procedure; give the policy of one subtask and --task."
        )
    if not steps or min(steps) < 0:
        raise InputError(
            f"steps are {', '.join(map(str, steps)) or 'none'}; give at least one, from 0."
        )
    side = min(agent.image_size, round(agent.image_size * agent.aspect))
    if not 2 <= patch <= side:
        raise InputError(f"patch is {patch}; it must be between 2 and the image's side, {side} px.")


def squares(height: int, width: int, patch: int) -> list[tuple[slice, slice]]:
    """Return squares half a side apart that cover an image [px], rows and columns."""
    down, across = (
        [*range(0, size - patch, max(patch // 2, 1)), size - patch] for size in (height, width)
    )
    return [(slice(y, y + patch), slice(x, x + patch)) for y in down for x in across]


def spread(
    image: Image, places: Sequence[tuple[slice, slice]], change: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the mean change over the squares that hide each pixel, (height, width)."""
    total = np.zeros(image.shape[:2])
    count = np.zeros(image.shape[:2])
    for place, value in zip(places, change, strict=True):
        total[place] += value
        count[place] += 1
    mean: NDArray[np.float64] = total / count
    return mean


def _drawn(observation: Observation) -> Mapping[str, Frame]:
    """Return an observation with its images rendered."""
    assert isinstance(observation, Mapping)  # the agent sees images
    return {key: observation[key] for key in observation}


def _without(
    seen: Mapping[str, Frame], view: str, place: tuple[slice, slice]
) -> Mapping[str, Frame]:
    """Return an observation with a square of one view covered with the view's mean colour."""
    image = seen[view].astype(np.uint8)
    image[place] = np.rint(image.mean(axis=(0, 1))).astype(np.uint8)
    return {**seen, view: image}


def _act(
    agent: Agent, slots: Sequence[int], env: Env, seen: Sequence[Observation]
) -> NDArray[np.float32]:
    """Return the agent's action in every slot, (n, 7)."""
    return agent.act(slots, [env] * len(slots), seen)
