"""Demonstrators: they label the states of a rollout, and act there unless something else does.

    demonstrator = make_demonstrator("expert", env)
    env.step(demonstrator.action())

A `Demonstrator` reads the env's whole, privileged state. In DAgger a `BehaviourPolicy` acts instead
of it for a while; the labels remain the demonstrator's.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import check_name
from surgicai_vision.core.plugins import resolve

if TYPE_CHECKING:
    from surgicai_vision.envs.base import Observation, SuturingEnv


class Miss(NamedTuple):
    """How far beside its goal a demonstrator aims.

    Attributes:
        along: past a grasp, along the needle towards its tip, or beside the path of an insertion,
            along the wound [m].
        across: beside that path, across the wound in the entry's plane [m]; a grasp ignores it.
    """

    along: float = 0.0
    across: float = 0.0


ON_AIM = Miss()


class Demonstrator(ABC):
    """Labels the states of one episode; a new one is created for every episode.

    Attributes:
        late: by how many control steps it notices a loss late, if it is a demonstrator that goes
            back (`Disturbance.late`).
    """

    late: int = 0

    @property
    def persists(self) -> bool:
        """Return True if an episode continues after its success, up to its limit."""
        return False

    @property
    def gives_up(self) -> str:
        """Return why the demonstrator cannot continue, which fails the episode, or ""."""
        return ""

    @property
    def source(self) -> str:
        """Return the sha256 of the file of the demonstration that the episode re-poses, or ""."""
        return ""

    @abstractmethod
    def action(self) -> NDArray[np.float32]:
        """Return the action for the env's present state, (7,) in [-1, 1]."""

    def missing(self, miss: Miss) -> NDArray[np.float32]:
        """Return the action with which a grasp or an insertion would miss, (7,) in [-1, 1].

        Args:
            miss: how far beside its goal it aims. A demonstrator that cannot miss
                (`AIMING_DEMONSTRATORS`) ignores it.
        """
        return self.action()


class BehaviourPolicy(ABC):
    """Acts instead of the demonstrator at first; the labels remain the demonstrator's."""

    @abstractmethod
    def reset(self, env: "SuturingEnv", seed: int, rng: np.random.Generator) -> None:
        """Start an episode: `env` has been reset."""

    @abstractmethod
    def action(self, env: "SuturingEnv", observation: "Observation") -> NDArray[np.float32] | None:
        """Return the action to execute, (7,), or None once the demonstrator acts itself."""


DEMONSTRATORS: Mapping[str, str] = MappingProxyType(
    {
        "expert": "surgicai_vision.demos.expert:Expert",
        "dmp": "surgicai_vision.demos.dmp.controller:DmpController",
        "search": "surgicai_vision.demos.search_expert:SearchExpert",
        "recover": "surgicai_vision.demos.recovery_expert:RecoveryExpert",
        "multiply": "surgicai_vision.demos.multiply.multiplier:Multiplier",
    }
)
"""Name → "module:class", imported on first use."""

LEARNING_DEMONSTRATORS = frozenset({"dmp", "multiply"})
"""Those that learn from demonstrations, which their class takes as a second argument."""

CHOOSING_DEMONSTRATORS = frozenset({"multiply"})
"""Those that take one demonstration per episode; their class's third argument says how."""

NEAREST = "nearest"
RANDOM = "random"
SOURCES = (NEAREST, RANDOM)
"""How a choosing demonstrator takes one: the one with the most similar start, or any."""

GOAL_FREE_DEMONSTRATORS = frozenset({"search"})
"""Those that do not know at which point of the needle a grasp is requested, and try several."""

PERSISTING_DEMONSTRATORS = frozenset({"search"})
"""Those that continue after a success (`Demonstrator.persists`)."""

SCRIPTED_DEMONSTRATORS = tuple(name for name in DEMONSTRATORS if name not in LEARNING_DEMONSTRATORS)


def make_demonstrator(
    name: str, env: "SuturingEnv", demos: Sequence[str] = (), source: str = ""
) -> Demonstrator:
    """Return a demonstrator for an episode of `env`.

    Args:
        name: a key of `DEMONSTRATORS`.
        env: the env.
        demos: files of the demonstrations that a learning demonstrator learns from.
        source: how a choosing demonstrator takes one of them per episode; "" for its default.

    Raises:
        UnknownName: no demonstrator has that name.
    """
    kind = resolve(DEMONSTRATORS[check_name("demonstrator", name, DEMONSTRATORS)])
    arguments = [*([demos] if demos else []), *([source] if source else [])]
    demonstrator: Demonstrator = kind(env, *arguments)
    return demonstrator
