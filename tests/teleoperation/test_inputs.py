"""Inputs: keys and sticks become inputs; inputs become motions along the axes the person sees."""

import numpy as np
import pytest
from teleoperators import REST, event, right

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.scene.cameras import extrinsics
from surgicai_vision.teleoperation import gamepad, inputs
from surgicai_vision.teleoperation.gamepad import Gamepad
from surgicai_vision.teleoperation.input_map import InputMapping
from surgicai_vision.teleoperation.inputs import JAW, KEEP, Input, merge
from surgicai_vision.teleoperation.keyboard import CODES, PRESSES, TABLE, Keyboard, key_table

# -- devices ---------------------------------------------------------------------------------------


def test_keys_are_held_until_released():
    keyboard = Keyboard()
    keyboard.press("KeyD")
    keyboard.press("KeyI")
    keyboard.press("ShiftRight")
    for _ in range(3):
        assert keyboard.poll() == Input((1, 0, 0), (1, 0, 0), 0, True, ())
    keyboard.release("KeyD")
    keyboard.release("ShiftRight")
    assert keyboard.poll() == Input((0, 0, 0), (1, 0, 0), 0, False, ())
    keyboard.release_all()
    assert keyboard.poll() == REST


def test_a_tap_between_two_ticks_moves_once_and_a_press_counts_once():
    keyboard = Keyboard()
    for code in ("KeyW", "ArrowRight", "ArrowRight", "KeyF"):
        keyboard.press(code)
    keyboard.release("KeyW")
    assert keyboard.poll() == Input((0, -1, 0), events=(KEEP,))
    assert keyboard.poll() == REST, "an autorepeated key is no second press"


def test_opposite_keys_cancel_and_devices_add_up():
    keyboard = Keyboard()
    keyboard.press("KeyA")
    keyboard.press("KeyD")
    assert keyboard.poll().move == (0, 0, 0)
    both = merge((right(0.8), right(0.8), Input(turn=(0, 0, -1), events=(JAW,))))
    assert both == Input((1.0, 0, 0), (0, 0, -1.0), 0, False, (JAW,))
    assert merge(()) == REST


def test_the_key_table_names_every_key_once():
    named = [code for row in TABLE for code in row.codes]
    assert sorted(named) == sorted(CODES)
    assert set(PRESSES.values()) == set(inputs.EVENTS) == set(gamepad.PRESSES.values())
    assert all(row.meaning in key_table() for row in TABLE)


def test_a_gamepad_rests_near_the_middle_and_reaches_both_ends():
    pad = Gamepad()
    pad.update([0.1, -0.1, 0.05, 0.0], [])
    assert not pad.poll().is_moving
    buttons = [0.0] * 16
    buttons[6], buttons[4], buttons[2], buttons[13] = 1.0, 1.0, 1.0, 1.0
    pad.update([1.0, -1.0, 1.0, -1.0], buttons)
    assert pad.poll() == Input((1, -1, -1), (1, 1, -1), -1, True, ())
    deflections = np.linspace(-1, 1, 41)
    speeds = [gamepad.curve(value) for value in deflections]
    assert np.all(np.diff(speeds) >= 0)
    np.testing.assert_allclose(speeds, np.negative(speeds)[::-1])


def test_a_gamepad_button_counts_once_a_press():
    pad = Gamepad()
    for _ in range(3):
        pad.update([], [1.0, *[0.0] * 14, 1.0])
    assert pad.poll().events == (JAW, KEEP)
    pad.release_all()
    pad.update([], [1.0])
    assert pad.poll().events == (), "it was down all the time"
    pad.update([], [])
    pad.update([], [1.0])
    assert pad.poll().events == (JAW,)


# -- mapping ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def grasp():
    """A real env of the subtask grasp."""
    env = envs.make(TaskConfig("grasp"))
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.parametrize("view", ["front", "back", "wrist_psm2", "front_psm2"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_key_moves_the_tool_along_its_cameras_axis(grasp, view, axis):
    grasp.reset(seed=0)
    camera = extrinsics(grasp.model, grasp.data, view)[:3, :3]
    before = np.array(grasp.simulation.tip("psm2")[:3])
    mapping = InputMapping(grasp, speed=1.0)
    # A wrist camera moves with the tool: only the first steps follow its initial axes.
    for _ in range(8):
        grasp.step(mapping.action(Input(tuple(float(i == axis) for i in range(3))), view))
    moved = camera.T @ (np.array(grasp.simulation.tip("psm2")[:3]) - before)
    assert moved[axis] > 2e-3
    assert moved[axis] > 0.9 * np.linalg.norm(moved)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_key_turns_the_tool_about_its_cameras_axis(grasp, axis):
    grasp.reset(seed=0)
    action = InputMapping(grasp, speed=1.0).action(
        Input(turn=tuple(float(i == axis) for i in range(3))), "front"
    )
    base = np.array(grasp.simulation.bases["psm2"][3:]).reshape(3, 3)
    camera = extrinsics(grasp.model, grasp.data, "front")[:3, :3]
    np.testing.assert_allclose(camera.T @ base @ action[3:6], np.eye(3)[axis], atol=1e-6)
    assert not action[:3].any()


def test_in_the_tools_frame_deeper_is_out_between_the_jaws(grasp):
    grasp.reset(seed=0)
    tip = np.array(grasp.simulation.tip("psm2")).copy()
    mapping = InputMapping(grasp, "tool", speed=1.0)
    for _ in range(8):
        grasp.step(mapping.action(Input((0, 0, 1)), "front"))
    moved = np.array(grasp.simulation.tip("psm2")[:3]) - tip[:3]
    assert moved @ tip[3:].reshape(3, 3)[:, 2] > 0.95 * np.linalg.norm(moved) > 1e-3


def test_speed_fine_and_diagonals(grasp):
    grasp.reset(seed=0)
    lengths = {}
    for name, given in {
        "one": right(),
        "two": Input((1, 1, 1)),
        "fine": Input((1, 0, 0), fine=True),
    }.items():
        lengths[name] = np.linalg.norm(InputMapping(grasp, speed=0.5).action(given, "front")[:3])
    np.testing.assert_allclose(
        [lengths["one"], lengths["two"], lengths["fine"]], [0.5, 0.5, 0.1], rtol=1e-6
    )
    for speed in (0, 1.1, float("nan")):
        with pytest.raises(InputError, match="speed is"):
            InputMapping(grasp, speed=speed)
    with pytest.raises(InputError, match="Did you mean 'camera'"):
        InputMapping(grasp, "camra")


def test_the_jaw_toggle_closes_an_open_jaw_and_opens_a_closed_one(grasp):
    grasp.reset(seed=0)
    mapping, jaw = InputMapping(grasp), lambda: grasp.simulation.commands["psm2"].jaw
    for wanted in (0.0, 0.4, 0.0):
        grasp.step(mapping.action(event(JAW), "front"))
        steps = 0
        while mapping.is_busy:
            grasp.step(mapping.action(REST, "front"))
            steps += 1
        assert jaw() == pytest.approx(wanted, abs=1e-6)
        assert steps < 20
    grasp.step(mapping.action(event(JAW), "front"))
    half = grasp.step(mapping.action(Input(jaw=-0.5), "front")) and jaw()
    grasp.step(mapping.action(REST, "front"))
    assert jaw() == half > 0, "a held key ends what a toggle began"
