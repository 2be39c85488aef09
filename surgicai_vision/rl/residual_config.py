"""How a residual policy is trained, as data; light to import. See `rl.residual`."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import final

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError, check_at_least
from surgicai_vision.rl.algorithms import SB3, Algorithm
from surgicai_vision.rl.settings import Settings, changed_settings

ALGO = "td3"
"""The algorithm of the correction."""
CORRECTION = Algorithm(
    SB3,
    "TD3",
    "Silver et al., Residual policy learning, arXiv:1812.06298",
    (
        "hidden",
        "learning_rate",
        "gamma",
        "batch_size",
        "tau",
        "train_every",
        "updates",
        "learning_starts",
        "critics",
        "exploration_noise",
        "actor_starts",
        "policy_delay",
        "target_noise",
        "target_noise_clip",
        "bc_weight",
        "normalise_q",
        "clip_q",
    ),
    {
        "hidden": [256, 256],
        "learning_rate": 3e-4,
        "train_every": 1,
        "learning_starts": 3000,
        "exploration_noise": 0.3,
        "actor_starts": 3000,
        "bc_weight": 0.1,
    },
)
"""TD3 for learning a correction. The noise is a share of the bound. Critics that have seen little
send the actor anywhere within it, so only they learn at first, and `bc_weight` keeps the actor
close to the frozen policy (docs/results/rl.md)."""
BOUND = 0.3
"""Largest correction of each element of an action, by default."""


def residual_settings(changes: Mapping[str, JSON]) -> Settings:
    """Return the settings of a correction with changes; see `rl.settings.settings_of`."""
    return changed_settings(CORRECTION, "a correction", changes)


@final
@dataclass(frozen=True)
class ResidualRequest:
    """Everything that determines a residual policy.

    Attributes:
        base: checkpoint folder of the policy to correct, or `released:NAME`; a behaviour-cloning
            policy of one subtask.
        bound: largest correction of each element of an action.
        settings: TD3's settings.
        changes: the settings that were changed, "key=value" each; they enter the run's name.
        env_steps: control steps taken in the env.
        seed: seed of the correction, batches, noise and starts.
        validation: episodes of each evaluation during training, from validation starts.
        save_every: control steps between evaluations and training states.
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
        for name in (setting.name for setting in fields(Settings)):
            is_read = name in CORRECTION.settings
            if not is_read and getattr(self.settings, name) != getattr(Settings, name):
                raise InputError(f"A residual policy reads no {name}; leave it out.")
        if self._most_updates <= self.settings.actor_starts:
            raise InputError(
                f"env_steps is {self.env_steps}, so there are at most {self._most_updates} "
                f"updates, but the actor learns only after {self.settings.actor_starts}; give "
                "more, or a lower learning_starts or actor_starts."
            )

    @property
    def _most_updates(self) -> int:
        """Updates of the critics if each action is one control step; fewer if it is held."""
        settings = self.settings
        learned = max(0, self.env_steps - settings.learning_starts)
        return -(-learned // settings.train_every) * settings.updates
