"""The interface of a learner for `train`: advance, report progress, export the actor, save state.

A state is a table of tensors, numbers and texts, so that it can be read without running code
(`torch.load(weights_only=True)`).
"""

import abc
import json
from collections.abc import Mapping
from typing import Any, final

import numpy as np
import torch
from torch import nn

from policies.base import Policy

State = dict[str, Any]
"""Names → tensors, numbers, texts, or tables of them."""


class Diverged(Exception):
    """The actor's actions are not finite."""


class Learner(abc.ABC):
    """One running algorithm.

    Attributes:
        squash: how its actor's mean becomes an action (`policies.actor.SQUASHES`).
        mean: mean subtracted from each input, (n,).
        std: standard deviation each input is then divided by, (n,).
    """

    squash = "tanh"
    mean: torch.Tensor
    std: torch.Tensor

    @property
    @abc.abstractmethod
    def done(self) -> int:
        """Return the control steps taken; offline, the updates."""

    @property
    @abc.abstractmethod
    def updates(self) -> int:
        """Return the updates of the weights."""

    @abc.abstractmethod
    def advance(self, target: int) -> dict[str, float]:
        """Learn until `done` is `target` or slightly more; return the last losses by name.

        Raises:
            Diverged: the actor's actions are not finite.
        """

    @abc.abstractmethod
    def fill(self, policy: Policy) -> None:
        """Copy the weights of the library's actor into our policy (`Algorithm.policy`)."""

    @abc.abstractmethod
    def get_state(self) -> State:
        """Return everything that the next step depends on."""

    @abc.abstractmethod
    def set_state(self, state: State) -> None:
        """Restore what `get_state` returned."""

    @abc.abstractmethod
    def close(self) -> None:
        """Free envs and processes."""


def linear(module: nn.Module) -> list[nn.Linear]:
    """Return the linear layers of a network, in order."""
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def random_state() -> State:
    """Return the state of the generators that the libraries draw from: numpy's and torch's own."""
    kind, keys, position, has_gauss, cached = np.random.get_state(legacy=True)  # noqa: NPY002
    return {
        "numpy": torch.from_numpy(np.asarray(keys).astype(np.int64)),
        "numpy_rest": json.dumps([str(kind), int(position), int(has_gauss), float(cached)]),
        "torch": torch.get_rng_state(),
    }


def set_random_state(state: State) -> None:
    """Restore what `random_state` returned."""
    kind, position, has_gauss, cached = json.loads(state["numpy_rest"])
    keys = state["numpy"].numpy().astype(np.uint32)
    np.random.set_state((kind, keys, position, has_gauss, cached))  # noqa: NPY002
    torch.set_rng_state(state["torch"])


@final
class Arrays:
    """Read and write the array attributes of an object, such as a replay buffer."""

    @staticmethod
    def of(owner: object, names: tuple[str, ...], rows: int) -> State:
        """Return the first rows of arrays, or of dicts of arrays, as tensors."""
        return {name: _tensors(getattr(owner, name), rows) for name in names}

    @staticmethod
    def put(owner: object, state: Mapping[str, Any]) -> None:
        """Write back what `of` returned."""
        for name, value in state.items():
            _write(getattr(owner, name), value)


def _tensors(value: Any, rows: int) -> Any:
    if isinstance(value, Mapping):
        return {key: _tensors(part, rows) for key, part in value.items()}
    return torch.from_numpy(np.ascontiguousarray(value[:rows]))


def _write(into: Any, value: Any) -> None:
    if isinstance(into, Mapping):
        for key, part in into.items():
            _write(part, value[key])
    else:
        into[: len(value)] = value.numpy()
