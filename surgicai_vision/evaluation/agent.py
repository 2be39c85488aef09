"""The agent: what acts in an evaluation, with every member that callers use."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from surgicai_vision.envs import base
    from surgicai_vision.scene.rendering import Frame

type Env = base.SuturingEnv
type Observation = base.Observation
type Actions = NDArray[np.float32]
"""One action a slot, (n, 7)."""
type FeatureTable = dict[tuple[str, tuple[str, ...]], dict[int, NDArray[np.float32]]]
"""(encoder's fingerprint, views) → id of an observation → its features."""


def frame_of(observation: Observation, key: str) -> "Frame":
    """Return a camera's frame (height, width, channels) by its key, such as "front_depth"."""
    assert isinstance(observation, Mapping), "the env of an agent with cameras shows images"
    return observation[key]


class Agent(abc.ABC):
    """What acts in the slots of an evaluation.

    Attributes:
        name: how the agent is called in rows and tables.
        cameras: cameras it needs, empty for none.
        image_size: height and width of their images [px].
        depth: whether it needs their depth too.
    """

    name: str
    cameras: tuple[str, ...] = ()
    image_size: int = 224
    depth: bool = False

    @abc.abstractmethod
    def reset(self, slot: int, env: Env, seed: int) -> None:
        """Forget the slot's last episode; `env` has just been reset with `seed`."""

    @abc.abstractmethod
    def act(
        self, slots: Sequence[int], envs: Sequence[Env], observations: Sequence[Observation]
    ) -> Actions:
        """Return the actions (len(slots), 7) of the running slots."""

    def restart(self, slot: int) -> None:
        """Forget what the slot has planned: its subtask begins, within the same episode."""
        return

    def share(self, features: FeatureTable) -> None:
        """Look features up in a table that agents share; its owner empties it each step."""
        return


MakeAgent = Callable[[], Agent]
"""Makes the agent inside a worker process; must be picklable (a function or a
functools.partial).
"""
