"""Occlusion sensitivity: only what matters is found; each slot's memory is separate."""

from dataclasses import replace

import numpy as np
import pytest

from surgicai_vision.commands import saliency
from surgicai_vision.commands.console import Console
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation import occlusion as module
from surgicai_vision.evaluation.agent import Agent, frame_of
from surgicai_vision.evaluation.agents import ZeroAgent
from surgicai_vision.evaluation.aimed_agent import AimedAgent
from surgicai_vision.evaluation.denoised_agent import DenoisedAgent
from surgicai_vision.evaluation.occlusion import occlusion, overlaid, squares

SIZE = 48
CORNER = (slice(4, 12), slice(30, 38))
"""All that the agent looks at, in its first view."""


class CornerAgent(Agent):
    """Acts on one corner of one view, and on how often the slot was queried."""

    name = "corner"
    cameras = ("front", "back")
    image_size = SIZE

    def __init__(self):
        self.asked = {}

    def reset(self, slot, robot, seed):
        self.asked[slot] = 0

    def act(self, slots, robots, observations):
        actions = np.zeros((len(slots), 7), np.float32)
        for row, (slot, observation) in enumerate(zip(slots, observations, strict=True)):
            seen = frame_of(observation, "front")[CORNER].astype(np.float32)
            actions[row, 0] = seen.std() / 255
            actions[row, 1] = 0.01 * self.asked[slot]
            self.asked[slot] += 1
        return actions


def make_agent():
    return CornerAgent()


CONFIG = TaskConfig("grasp", max_steps=4)


@pytest.fixture(scope="module")
def found():
    return occlusion(CornerAgent(), CONFIG, seed=3, steps=(0, 2, 99), patch=8)


def test_only_what_it_looks_at_matters(found):
    assert [(one.step, one.view) for one in found.found] == [
        (step, view) for step in (0, 2) for view in ("front", "back")
    ]
    for one in found.found:
        matters = one.change > 1e-6
        if one.view == "back":
            assert not matters.any()
            continue
        assert matters[CORNER].all()
        away = np.ones((SIZE, SIZE), bool)
        away[0:20, 22:46] = False  # squares that reach into the corner
        assert not matters[away].any()
        y, x = np.unravel_index(one.change.argmax(), one.change.shape)
        assert 0 <= y < 16 and 26 <= x < 42


def test_squares_cover_the_image_and_colour_says_how_much(found):
    for height, width, patch in (
        (48, 48, 8),
        (50, 50, 16),
        (16, 16, 16),
        (48, 64, 8),
        (50, 36, 16),
    ):
        count = np.zeros((height, width))
        for place in squares(height, width, patch):
            count[place] += 1
        assert count.min() >= 1
    first = found.found[0]
    shown = overlaid(first, found.largest)
    changed = (shown != first.image).any(axis=-1)
    assert changed.any() and not changed[first.change < 1e-6].any()
    assert len(found.sheet("title").axes) == 2 * 4


def test_refuses_what_cannot_be_asked():
    with pytest.raises(InputError, match="sees no images"):
        occlusion(ZeroAgent(), CONFIG, 0, (0,), 8)
    with pytest.raises(InputError, match="whole procedure"):
        occlusion(CornerAgent(), TaskConfig("suture"), 0, (0,), 8)
    with pytest.raises(InputError, match="give at least one, from 0"):
        occlusion(CornerAgent(), CONFIG, 0, (), 8)
    with pytest.raises(InputError, match="the image's side, 48 px"):
        occlusion(CornerAgent(), CONFIG, 0, (0,), 64)


def test_the_command_draws_a_sheet(tmp_path):
    options = saliency.Options(
        policy=f"{__name__}:make_agent",
        task="grasp",
        step=(0,),
        patch=16,
        out=tmp_path / "saliency.png",
        env={"max_steps": 2},
    )
    result = saliency.run(options, console=Console())
    assert result["steps"] == 2 and (tmp_path / "saliency.png").stat().st_size > 10_000
    assert module.COVER < 1


class WideAgent(CornerAgent):
    """Sees images that are wider than high."""

    aspect = 4 / 3


def test_an_image_that_is_wider_than_high_is_covered_whole():
    found = occlusion(WideAgent(), CONFIG, seed=3, steps=(0,), patch=8)
    assert [one.change.shape for one in found.found] == [(SIZE, 64)] * 2
    assert all(np.isfinite(one.change).all() for one in found.found) and found.largest > 0


class CropAgent(CornerAgent):
    """Looks at the middle of a crop."""

    cameras = ("front_psm2",)

    def act(self, slots, robots, observations):
        middle = slice(SIZE // 2 - 4, SIZE // 2 + 4)
        actions = np.zeros((len(slots), 7), np.float32)
        actions[:, 0] = [
            frame_of(seen, "front_psm2")[middle, middle].std() for seen in observations
        ]
        return actions


class FixedDetector:
    """Sees both arms' jaws at one place; counts how often it was asked."""

    def __init__(self, place):
        self.place, self.asked = place, 0

    def find(self, images, camera):
        self.asked += 1
        return np.full((1, 2, 2), self.place, np.float32), np.ones((1, 2), np.float32)


def test_parts_of_aimed_crops_are_hidden_from_the_policy_and_not_from_the_detector():
    detectors = FixedDetector(0.4), FixedDetector(0.6)
    one, other = (
        occlusion(AimedAgent(CropAgent(), detector), CONFIG, 3, (0,), 16).found[0]
        for detector in detectors
    )
    assert one.view == "front_psm2" and one.image.shape == (SIZE, SIZE, 3)
    assert not np.array_equal(one.image, other.image) and one.change.max() > 0
    assert [detector.asked for detector in detectors] == [CONFIG.max_steps] * 2


def test_parts_of_averaged_images_are_hidden_after_they_are_averaged():
    place = FixedDetector(0.4)
    plain, averaged = (
        occlusion(agent, CONFIG, 3, (0, 1), 16)
        for agent in (
            AimedAgent(CropAgent(), place),
            DenoisedAgent(AimedAgent(CropAgent(), place), 6),
        )
    )
    for one, other in zip(plain.found, averaged.found, strict=True):
        assert (one.view, one.step) == (other.view, other.step) and other.change.max() > 0
    assert np.array_equal(plain.found[0].image, averaged.found[0].image), "the first as it is"


def make_crop_agent():
    return CropAgent()


def test_the_command_aims_the_crops(tmp_path, capsys):
    options = saliency.Options(
        policy=f"{__name__}:make_crop_agent",
        task="grasp",
        step=(0,),
        patch=16,
        detector="released:detector",
        out=tmp_path / "saliency.png",
        env={"max_steps": 2},
    )
    result = saliency.run(options, console=Console())
    assert "-aimed-" in result["policy"] and (tmp_path / "saliency.png").stat().st_size > 10_000
    refused = replace(options, policy=f"{__name__}:make_agent")
    with pytest.raises(InputError, match="aims crops"):
        saliency.run(refused, console=Console())
