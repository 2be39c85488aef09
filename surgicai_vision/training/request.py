"""The request of a training: its data, its policy, its recipe.

`check_request` refuses what cannot be trained; `request_table` is the data that marks a folder
(`training.folder`).
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from policies.base import Plugin, Policy, Recipe
from surgicai_vision import __version__
from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, digest, to_identity
from surgicai_vision.core.errors import InputError, first_line
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.features.cache import Features
from surgicai_vision.training.checkpoint import Checkpoint
from surgicai_vision.training.data import column
from surgicai_vision.training.run_config import RunConfig


@dataclass(frozen=True)
class TrainingRequest:
    """What is to be trained."""

    dataset: Dataset
    features: tuple[Features, ...]
    policy: Plugin
    recipe: Recipe
    seed: int
    run: RunConfig
    progress_policy: Checkpoint | None = None

    @property
    def trained_run(self) -> RunConfig:
        """The run, completed with what its features and its dataset determine."""
        first = self.features[0].manifest if self.features else None
        return replace(
            self.run,
            env=self.dataset.config,
            policy=self.policy.name,
            encoder=first["encoder"] if first else None,
            views=tuple(entry.view for entry in self.features),
            pool=first["pool"] if first else "global",
            privileged=self.recipe.privileged,
            demonstrations=len(np.unique(self.dataset.demonstration_index)),
            seed=self.seed,
        )

    @functools.cached_property
    def columns(self) -> Mapping[str, NDArray[np.generic]]:
        """The columns fed alongside features (else the state) and the one learned, by name."""
        with torch.random.fork_rng(devices=[]):
            vector = self.untrained().inputs.vector
        keys = (*(vector or (names.STATE,)), self.policy.target)
        return {key: column(self.dataset, key) for key in keys}

    def untrained(self) -> Policy:
        """Return the untrained policy.

        Raises:
            InputError: the recipe's network is too large for this machine.
        """
        try:
            return self.policy.make(self.recipe, tuple(entry.shape for entry in self.features))
        except (RuntimeError, MemoryError) as error:  # torch has no specific error for this
            raise InputError(
                f"Policy '{self.policy.name}' cannot be built from its recipe "
                f"({first_line(error)}); choose smaller layers."
            ) from None


def check_request(request: TrainingRequest) -> None:
    """Refuse what cannot be trained, before any work."""
    if not isinstance(request.recipe, request.policy.recipe):
        raise InputError(
            f"Policy '{request.policy.name}' needs a {request.policy.recipe.__name__}."
        )
    if request.features and request.dataset.config.randomisation.shows_heldout:
        held = ", ".join(names.HELDOUT_APPEARANCES)
        raise InputError(
            f"The dataset shows looks that are held out for tests ({held}); record one with "
            f"randomisation appearance: {names.TRAIN} and appearance_shift: 0."
        )
    for entry in request.features:
        if (
            entry.manifest["dataset"] != request.dataset.fingerprint
            or len(entry.rows) != request.dataset.length
        ):
            raise InputError(
                f"The features of view '{entry.view}' are of another dataset; encode this one."
            )
    if len({entry.manifest["encoder_fingerprint"] for entry in request.features}) > 1:
        raise InputError(
            "The features come from several encoders; encode every view by the same one."
        )
    for key, values in request.columns.items():
        if not np.isfinite(values).all():
            raise InputError(f"Column '{key}' of the dataset holds values that are not finite.")


def request_table(request: TrainingRequest, start: Policy | None) -> dict[str, JSON]:
    """Return everything that decides the result, as plain data.

    Args:
        request: what is trained.
        start: the trained policy to start from.
    """
    first = request.features[0].manifest if request.features else None
    weights = () if start is None else start.state_dict().values()
    return {
        "policy": request.policy.name,
        "recipe": to_identity(request.recipe),
        "seed": request.seed,
        "dataset": request.dataset.fingerprint,
        "views": [entry.view for entry in request.features],
        "encoder": first["encoder_fingerprint"] if first else None,
        "start": None
        if start is None
        else digest([float(values.double().sum()) for values in weights]),
        "code_version": __version__,
    }
