"""Occlusion sensitivity: only what matters is found; each slot's memory is separate."""

import numpy as np
import pytest

from surgicai_vision.commands import saliency
from surgicai_vision.commands.console import Console
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation import occlusion as module
from surgicai_vision.evaluation.agent import Agent, frame_of
from surgicai_vision.evaluation.agents import ZeroAgent
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
    for size, patch in ((48, 8), (50, 16), (16, 16)):
        count = np.zeros((size, size))
        for place in squares(size, patch):
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
