"""A simulation served in this process; it steps whenever the client waits."""

import functools

from memory_transport import MemoryTransport

from surgicai_vision import envs
from surgicai_vision.core.config import ADVANCES, TaskConfig
from surgicai_vision.robot.recorder import Recorder
from surgicai_vision.robot.server import ServeConfig, Server
from surgicai_vision.robot.simulated import SimulatedRobot

SEED = 900_003


@functools.cache
def env_of(task, advance=ADVANCES[0]):
    return envs.make(TaskConfig(task, advance=advance))


class Served(MemoryTransport):
    """A transport to a stepped server that is polled whenever the client waits."""

    def __init__(self, task, views=(), recordings=None, tell=None, size=64, advance=ADVANCES[0]):
        super().__init__()
        self.robot = SimulatedRobot(env_of(task, advance))
        self.robot.reset(SEED)
        config = ServeConfig("stepped", views=views, size=(size, size))
        recorder = Recorder(self.robot, recordings, tell) if recordings else None
        self.server = Server(self.robot, self, config, recorder)
        self.server.__enter__()

    def wait(self, seconds):
        self.server.poll()
