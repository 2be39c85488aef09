"""A small stand-in for the suturing environment: numpy only, the same interface, no GL.

The state is [goal, position, step, command]; each image is a function of it. Used where a test is
about files and processes, not about images.
"""

from types import SimpleNamespace

import numpy as np

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.demonstrator import Demonstrator


class FakeCalibration:
    """The fake's camera calibration: a window that moves with the position."""

    def __init__(self, env):
        self._env = env

    def intrinsics(self, view, size):
        matrix = np.diag([300.0, 300.0, 1.0])
        matrix[:2, 2] = (size[1] - 1) / 2 - self._env.state[1]
        return matrix

    def extrinsics(self, view):
        return np.eye(4)


class FakeTaskState:
    """The fake's count of steps, which is part of its state."""

    tip_path = 0.0

    def __init__(self, env):
        self._env = env

    @property
    def steps(self):
        return self._env.state[2]

    @steps.setter
    def steps(self, steps):
        self._env.state[2] = steps


class FakeEnv:
    def __init__(
        self,
        config=None,
        cameras=("front", "back"),
        image_size=32,
        depth=False,
        segmentation=False,
        aimed=False,
        **_,
    ):
        self.config = config or TaskConfig(max_steps=12)
        self.cameras, self.size, self.depth, self.segmentation = (
            cameras,
            image_size,
            depth,
            segmentation,
        )
        self.scene = SimpleNamespace(hash="f" * 64)
        self.model = self.data = None
        self.calibration = FakeCalibration(self)
        self.simulation = SimpleNamespace(task_state=FakeTaskState(self))
        self.phase = 0
        self.state = np.zeros(4)

    def reset(self, seed=0, options=None):
        self.state = np.array([np.random.default_rng(seed).uniform(0.3, 0.6), 0.0, 0.0, 0.0])
        return self.observe(), {}

    def step(self, action):
        self.state = self.state + np.array([0.0, 0.1 * float(action[0]), 1.0, float(action[6])])
        success = abs(self.state[0] - self.state[1]) < 0.06
        info = {"is_success": success, "contact": success, "physics_error": False}
        return (
            self.observe(),
            0.0 if success else -1.0,
            success,
            self.state[2] >= self.config.max_steps,
            info,
        )

    def get_state(self):
        return self.state.copy()

    def set_state_vector(self, state):
        self.state = np.array(state)

    def agent_pos(self):
        return np.linspace(0, 1, 7).astype(np.float32) + np.float32(self.state[1])

    def both_arms(self):
        return np.concatenate([self.agent_pos(), self.agent_pos() + np.float32(1)])

    def setpoint(self):
        return np.full(7, self.state[1] / 10, np.float32)

    def state_vector(self):
        return np.full(21, self.state[0] - self.state[1], np.float32)

    def needle_pose(self):
        return np.array([self.state[0], 0, 0, 1, 0, 0, 0], np.float32)

    def observe(self):
        y, x = np.mgrid[: self.size, : self.size]
        views = {}
        for number, camera in enumerate(self.cameras):
            red = 40 + 10 * self.state[2] + x
            views[camera] = np.stack(
                [red, 90 * number + y, x * 0 + 100 * self.state[0]], -1
            ).astype(np.uint8)
        observation = views | {"agent_pos": self.agent_pos()}
        if self.depth:
            depth = (0.1 + 0.001 * y + 0.01 * self.state[1]).astype(np.float32)[..., None]
            observation |= {f"{camera}_depth": depth for camera in self.cameras}
        if self.segmentation:
            parts = ((x + y + int(self.state[2])) % 6).astype(np.uint8)[..., None]
            observation |= {f"{camera}_segmentation": parts for camera in self.cameras}
        return observation


class FakeExpert(Demonstrator):
    def __init__(self, env):
        self.env = env

    def action(self):
        # This expert never reaches a goal beyond 0.55.
        goal, position = self.env.state[:2]
        speed = 0.0 if goal > 0.55 else np.clip((goal - position) / 0.1, -1, 1)
        return np.array([speed, 0, 0, 0, 0, 0, 1], np.float32)
