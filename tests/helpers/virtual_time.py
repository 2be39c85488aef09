"""A simulation served in virtual real time: the test's clock advances whenever someone waits."""

from types import SimpleNamespace

from memory_transport import MemoryTransport
from stepped_server import SEED, env_of

from surgicai_vision.robot.server import CONTROL_S, ServeConfig, Server
from surgicai_vision.robot.simulated import SimulatedRobot

MODULES = ("server", "client", "driver")
"""Modules of `surgicai_vision.robot` that read a clock."""
BEGINS = 100.0
"""First reading of the clock [s]."""


class VirtualTime(MemoryTransport):
    """A transport to a server that runs in virtual real time.

    Args:
        monkeypatch: replaces `time` by the clock.
        task: task of the served env.
        phase: delay of the server's first control step after the client's first moment [s].
    """

    def __init__(self, monkeypatch, task, phase=0.0):
        super().__init__()
        self.now = BEGINS
        clock = SimpleNamespace(
            monotonic=lambda: self.now,
            time=lambda: self.now,
            time_ns=lambda: 1_800_000_000_000_000_000 + int(self.now * 1e9),
            sleep=self.pass_time,
        )
        for module in MODULES:
            monkeypatch.setattr(f"surgicai_vision.robot.{module}.time", clock)
        self.robot = SimulatedRobot(env_of(task))
        self.robot.reset(SEED)
        self.server = Server(self.robot, self, ServeConfig())
        self.server.__enter__()
        self.begun = self.now + phase
        self.halves = 0
        self._halfway = {}

    def wait(self, seconds):
        """Let a little time pass, as if a message came."""
        self.pass_time(min(seconds, 0.001))

    def pass_time(self, seconds):
        """Let time pass, and let the server do what is due."""
        ends = self.now + seconds
        while (due := self.begun + self.halves * CONTROL_S / 2) <= ends:
            self.now = due
            if self.halves % 2:
                self.server._publish_states(self._halfway, self.server._stamp())
            else:
                self._halfway = self.server._tick()
            self.halves += 1
        self.now = ends
