"""Images in real time: rendered ahead, published once their state is the current one."""

import time

import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.robot.driver import AFTER_IMAGE_S, CONTROL_S, drawn_to_images
from surgicai_vision.robot.images import ImageThread

TASK = TaskConfig("grasp")


class Shown:
    """Cameras that show a state's needle, and keep what is published."""

    def __init__(self, env):
        self.env = env
        self.rendered = 0
        self.published = []

    def render(self):
        self.rendered += 1
        return tuple(self.env.simulation.needle())

    def publish_shots(self, shots, stamp):
        self.published.append((shots, stamp))


@pytest.fixture
def states():
    """Three states, and the needle's pose in each."""
    env = envs.make(TASK)
    found = []
    for seed in range(3):
        env.reset(seed=seed)
        found.append((env.get_state(), tuple(env.simulation.needle())))
    env.close()
    return found


@pytest.fixture
def running():
    made = []
    with ImageThread(TASK, lambda env: made.append(Shown(env)) or made[0]) as thread:
        wait_for(lambda: made)
        yield thread, made[0]


def wait_for(is_so):
    ends = time.monotonic() + 20.0
    while not is_so():
        assert time.monotonic() < ends
        time.sleep(0.001)


def test_a_state_is_rendered_ahead_and_published_when_it_is_there(running, states):
    thread, shown = running
    for stamp, (state, needle) in enumerate(states):
        thread.offer(state)
        wait_for(lambda stamp=stamp: shown.rendered == stamp + 1)
        assert len(shown.published) == stamp
        thread.release(stamp)
        wait_for(lambda stamp=stamp: len(shown.published) == stamp + 1)
        assert shown.published[-1] == (needle, stamp)


def test_what_a_reset_replaced_is_never_shown(running, states):
    thread, shown = running
    (before, _), (after, needle), _ = states
    thread.offer(before)
    wait_for(lambda: shown.rendered)
    thread.offer(after)
    thread.release(7)
    thread.release(8)
    wait_for(lambda: shown.published)
    assert shown.published == [(needle, 7)]


@pytest.mark.parametrize("phase_ms", range(20))
def test_control_steps_are_drawn_to_come_just_after_images(phase_ms):
    """From every phase within six steps, by at most 2 ms per step."""
    due = 1e-3 * phase_ms
    for _ in range(6):
        step = CONTROL_S + drawn_to_images(due)  # images arrive from 0 on, one per control step
        assert abs(step - CONTROL_S) <= 2e-3 + 1e-12
        due += step
    assert (due - AFTER_IMAGE_S + 1e-3) % CONTROL_S == pytest.approx(1e-3, abs=1e-6)
