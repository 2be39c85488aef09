"""What a residual policy is trained by, as data; light to import. See `rl.residual`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError, check_at_least
from surgicai_vision.rl.algorithms import SUCCESS
from surgicai_vision.rl.settings import Settings, settings_of

ALGO = "td3"
"""The algorithm of the correction."""
DEFAULTS: Mapping[str, JSON] = {
    "hidden": [256, 256],
    "learning_rate": 3e-4,
    "train_every": 1,
    "learning_starts": 3000,
    "exploration_noise": 0.3,
}
"""Settings of TD3 that differ from `Settings`; the noise is a share of the bound."""
BOUND = 0.3
"""Largest correction of each element of an action, by default."""


def residual_settings(changes: Mapping[str, JSON]) -> Settings:
    """Return the settings of a correction with changes; see `rl.settings.settings_of`."""
    return settings_of(ALGO, {**DEFAULTS, **changes})


@final
@dataclass(frozen=True)
class ResidualRequest:
    """Everything that decides a residual policy.

    Attributes:
        base: checkpoint folder of the policy that is corrected, or `released:NAME`: behaviour
            cloning of one subtask.
        bound: largest correction of each element of an action.
        settings: of TD3.
        changes: which of them were changed, "key=value" each; they name the run.
        env_steps: control steps taken in the env.
        seed: of the correction, batches, noise and starts.
        validation: episodes of each evaluation on the way, from validation starts.
        save_every: control steps from one evaluation and training state to the next.
    """

    base: str
    bound: float = BOUND
    settings: Settings = field(default_factory=lambda: residual_settings({}))
    changes: tuple[str, ...] = ()
    env_steps: int = 20_000
    seed: int = 0
    validation: int = 20
    save_every: int = 5000

    def __post_init__(self) -> None:
        if not 0 < self.bound <= 1:
            raise InputError(f"bound is {self.bound}; it must be above 0 and at most 1.")
        check_at_least(1, env_steps=self.env_steps, save_every=self.save_every)
        check_at_least(0, validation=self.validation, seed=self.seed)
        for name in ("envs", "stop_at", *SUCCESS):
            if getattr(self.settings, name) != getattr(Settings, name):
                raise InputError(f"A residual policy reads no {name}; leave it out.")
