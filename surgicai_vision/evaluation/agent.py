"""The agent: what acts in an evaluation, with every member that callers use.

An agent uses only the members of `Robot`, which every env has. An agent that reads the env's own
state (an expert, ends by measured success, a policy fed the privileged state) declares it in
`Agent.privileged` and gets its env from `simulated(robot)`.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names

if TYPE_CHECKING:
    from surgicai_vision.envs import base
    from surgicai_vision.scene.rendering import Frame

type Env = base.SuturingEnv
type Observation = base.Observation
type Actions = NDArray[np.float32]
"""One action per slot, (n, 7); (n, 16) for an agent with action mode "absolute"."""


class Robot(Protocol):
    """All that an agent may ask of the robot it moves, besides the images."""

    def agent_pos(self) -> NDArray[np.float32]:
        """Return the active arm's measured tip in its base, (7,): x y z, roll pitch yaw, jaw.

        In m and rad.
        """

    def both_arms(self) -> NDArray[np.float32]:
        """Return both arms' `agent_pos`, psm1 first, (14,)."""

    def setpoint(self) -> NDArray[np.float32]:
        """Return the offset of the active arm's set point from its measured tip, (7,).

        x y z [m] and the rotation vector [rad] in its base, and the jaw [rad].
        """

    def enter(self, phase: int) -> None:
        """Enter a subtask, an index in `names.SUBTASKS`: its arm becomes the active one."""


def simulated(robot: Robot) -> Env:
    """Return the env that a privileged agent (`Agent.privileged`) is given as its robot."""
    return cast("base.SuturingEnv", robot)


type FeatureTable = dict[tuple[str, str, int], NDArray[np.float32]]
"""Encoder's fingerprint, view, id of an observation → the features of that image."""


def frame_of(observation: Observation, key: str) -> "Frame":
    """Return a camera's frame (height, width, channels) by its key, such as "front_depth"."""
    assert isinstance(observation, Mapping), "the env of an agent with cameras shows images"
    return observation[key]


def image_of(observation: Observation, view: str) -> NDArray[np.uint8]:
    """Return a camera's colours (height, width, 3)."""
    return frame_of(observation, view).astype(np.uint8, copy=False)


class Agent(abc.ABC):
    """What acts in the slots of an evaluation.

    Attributes:
        name: the agent's name in messages; an evaluation sets it to the name in its tables.
        cameras: cameras it needs, empty for none.
        image_size: height of their images [px].
        aspect: width of their images over their height.
        depth: whether it needs their depth too.
        privileged: whether it reads the env's own state, so that it acts only in simulation.
        action_mode: what its actions are, one of `names.ACTION_MODES`: "increments" of the active
            arm, or "absolute" set-points of both (`envs.absolute`), which only an env takes.
    """

    name: str
    cameras: tuple[str, ...] = ()
    image_size: int = 224
    aspect: float = 1.0
    depth: bool = False
    privileged: bool = False
    action_mode: str = names.INCREMENTS

    @abc.abstractmethod
    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Forget the slot's last episode; `robot` has just been reset with `seed`."""

    @abc.abstractmethod
    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the actions (len(slots), 7) of the running slots; absolute ones have 16 values."""

    def part(self, camera: str) -> float:
        """Return the share of an image's height that it looks at (`corruption.Moment`).

        It is below 1 for the images from which it cuts crops.
        """
        return 1.0

    def restart(self, slot: int) -> None:
        """Forget what the slot has planned: a subtask begins within the same episode."""
        return

    def share(self, features: FeatureTable) -> None:
        """Look features up in a table that agents share; its owner empties it each step."""
        return


class WrappedAgent(Agent):
    """An agent behind something that changes what it sees; all else is the wrapped agent's.

    Attributes:
        agent: who acts.
    """

    def __init__(self, agent: Agent):
        self.name = agent.name
        self.cameras = agent.cameras
        self.image_size = agent.image_size
        self.aspect = agent.aspect
        self.depth = agent.depth
        self.privileged = agent.privileged
        self.action_mode = agent.action_mode
        self.agent = agent

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Reset the wrapped agent."""
        self.agent.reset(slot, robot, seed)

    def part(self, camera: str) -> float:
        """Return the wrapped agent's part."""
        return self.agent.part(camera)

    def restart(self, slot: int) -> None:
        """Restart the wrapped agent."""
        self.agent.restart(slot)

    def share(self, features: FeatureTable) -> None:
        """Let the wrapped agent share features."""
        self.agent.share(features)


MakeAgent = Callable[[], Agent]
"""Makes the agent inside a worker process; must be picklable (a function or a
functools.partial).
"""
