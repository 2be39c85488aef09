"""Scripted operators: they read the env and use keyboard or gamepad as a person would."""

import numpy as np
from fake_env import FakeEnv

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.teleoperation.gamepad import DEAD_ZONE, Gamepad
from surgicai_vision.teleoperation.input_map import FINE
from surgicai_vision.teleoperation.inputs import Input
from surgicai_vision.teleoperation.keyboard import MOTIONS, Keyboard

REST = Input()
SHORT = TaskConfig("grasp", max_steps=12)
VIEWS = ("front", "back")
FAST = 0.6
"""A motion above this share of full speed gets a full press, one below it a fine press."""


def event(name):
    return Input(events=(name,))


def right(x=1.0):
    return Input(move=(x, 0.0, 0.0))


def expert_motion(env, mapping, view):
    """Return the expert's action in the mapping's frame: move and turn (6,), and the jaw."""
    action = Expert(env).action().astype(np.float64)
    rotation = mapping.axes(view)
    return np.concatenate([action[:3] @ rotation, action[3:6] @ rotation]), float(action[6])


class GamepadOperator:
    """Moves a gamepad's sticks, triggers and bumpers, in steps of 1/127."""

    def __init__(self, session, mapping):
        self.session, self.mapping = session, mapping
        self.gamepad = Gamepad()

    def poll(self):
        motion, jaw = expert_motion(self.session.env, self.mapping, self.session.view)
        motion /= self.mapping.speed * max(
            1.0, np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])
        )
        left, up, depth, tilt, swing, roll = (deflection(value) for value in motion)
        buttons = np.zeros(16)
        buttons[7 if depth > 0 else 6] = abs(depth)
        buttons[5 if roll > 0 else 4] = abs(motion[5]) > 0.5
        buttons[13 if jaw < 0 else 12] = abs(jaw) > 0.5
        self.gamepad.update([left, up, swing, -tilt], buttons.tolist())
        return self.gamepad.poll()


def deflection(speed):
    """Return the deflection, in steps of 1/127, that the gamepad's curve turns into `speed`."""
    value = np.sign(speed) * (DEAD_ZONE + (1 - DEAD_ZONE) * np.sqrt(min(abs(speed), 1.0)))
    return float(np.round(value * 127) / 127) if abs(speed) > 1e-3 else 0.0


class KeyboardOperator:
    """Presses keys; later presses correct the error of earlier ones."""

    def __init__(self, session, mapping):
        self.session, self.mapping = session, mapping
        self.keyboard, self.remainder = Keyboard(), np.zeros(6)

    def poll(self):
        motion, jaw = expert_motion(self.session.env, self.mapping, self.session.view)
        motion = motion / self.mapping.speed
        fine = np.abs(motion).max() < FAST
        speed = FINE if fine else 1.0
        self.remainder = np.clip(self.remainder + motion, -1, 1)
        wanted = {"ShiftLeft"} if fine else set()
        for code, (axis, sign) in MOTIONS.items():
            if (self.remainder[axis] / speed if axis < 6 else jaw) * sign > 0.5:
                wanted.add(code)
        for code in [*MOTIONS, "ShiftLeft"]:
            (self.keyboard.press if code in wanted else self.keyboard.release)(code)
        user_input = self.keyboard.poll()
        for start, vector in ((0, user_input.move), (3, user_input.turn)):
            self.remainder[start : start + 3] -= (
                speed * np.array(vector) / max(1.0, np.linalg.norm(vector))
            )
        return user_input


class Script:
    """Plays one input per tick, then none."""

    def __init__(self, *inputs):
        self.inputs = list(inputs)

    def poll(self):
        return self.inputs.pop(0) if self.inputs else REST


class FakeMapping:
    """Mapping of the stand-in env: motion along x is its action."""

    is_busy = False

    def reset(self):
        pass

    def action(self, user_input, view):
        return np.array([user_input.move[0], 0, 0, 0, 0, 0, 0], np.float32)


class SessionEnv(FakeEnv):
    """The stand-in env with what else a session needs."""

    class subtask:
        name = "grasp"
        arm = "psm2"

    def measure(self):
        return {"d_trans": abs(self.state[0] - self.state[1]), "d_angle": 0.0, "contact": False}

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "d_trans": 0.0, "d_angle": 0.0}
