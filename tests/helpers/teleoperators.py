"""Scripted people: they look at the env and press what a person would, through the real keyboard
and gamepad.
"""

import numpy as np
from fake_env import FakeEnv

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.teleoperation.gamepad import DEAD, Gamepad
from surgicai_vision.teleoperation.input_mapping import FINE
from surgicai_vision.teleoperation.inputs import Input
from surgicai_vision.teleoperation.keyboard import MOTIONS, Keyboard

REST = Input()
SHORT = TaskConfig("grasp", max_steps=12)
VIEWS = ("front", "back")
FAST = 0.6
"""A motion above this share of full speed is worth a full press; below it a fine one."""


def event(name):
    return Input(events=(name,))


def right(x=1.0):
    return Input(move=(x, 0.0, 0.0))


def wish(env, steering, view):
    """Return the expert's action in the frame of the steering: move and turn (6,) and the jaw."""
    action = Expert(env).action().astype(np.float64)
    rotation = steering.axes(view)
    return np.concatenate([action[:3] @ rotation, action[3:6] @ rotation]), float(action[6])


class AtGamepad:
    """Steers by both sticks, triggers and bumpers of a gamepad, in steps of 1/127 as they come."""

    def __init__(self, session, steering):
        self.session, self.steering = session, steering
        self.gamepad = Gamepad()

    def poll(self):
        motion, jaw = wish(self.session.env, self.steering, self.session.view)
        motion /= self.steering.speed * max(
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
    """Return the deflection, in steps of 1/127, that the gamepad's curve makes `speed` of."""
    value = np.sign(speed) * (DEAD + (1 - DEAD) * np.sqrt(min(abs(speed), 1.0)))
    return float(np.round(value * 127) / 127) if abs(speed) > 1e-3 else 0.0


class AtKeyboard:
    """Steers by keys alone, down or up; what one press was too much or too little, the next ones
    make good.
    """

    def __init__(self, session, steering):
        self.session, self.steering = session, steering
        self.keyboard, self.owed = Keyboard(), np.zeros(6)

    def poll(self):
        motion, jaw = wish(self.session.env, self.steering, self.session.view)
        motion = motion / self.steering.speed
        fine = np.abs(motion).max() < FAST
        speed = FINE if fine else 1.0
        self.owed = np.clip(self.owed + motion, -1, 1)
        wanted = {"ShiftLeft"} if fine else set()
        for code, (axis, sign) in MOTIONS.items():
            if (self.owed[axis] / speed if axis < 6 else jaw) * sign > 0.5:
                wanted.add(code)
        for code in [*MOTIONS, "ShiftLeft"]:
            (self.keyboard.press if code in wanted else self.keyboard.release)(code)
        given = self.keyboard.poll()
        for start, vector in ((0, given.move), (3, given.turn)):
            self.owed[start : start + 3] -= (
                speed * np.array(vector) / max(1.0, np.linalg.norm(vector))
            )
        return given


class Script:
    """Says one input a tick, then nothing."""

    def __init__(self, *inputs):
        self.inputs = list(inputs)

    def poll(self):
        return self.inputs.pop(0) if self.inputs else REST


class Still:
    """Steering of the stand-in env: motion along x is its action."""

    busy = False

    def reset(self):
        pass

    def action(self, given, view):
        return np.array([given.move[0], 0, 0, 0, 0, 0, 0], np.float32)


class Stand(FakeEnv):
    """The stand-in env with what a session asks besides."""

    class subtask:
        arm = "psm2"

    def measure(self):
        return {"d_trans": abs(self.state[0] - self.state[1]), "d_angle": 0.0, "contact": False}

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "d_trans": 0.0, "d_angle": 0.0}
