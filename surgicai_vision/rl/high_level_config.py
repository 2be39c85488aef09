"""How PPO is trained as a high-level policy, as data; light to import. See `rl.high_level`."""

from dataclasses import dataclass, field
from typing import final

from surgicai_vision.core.config import check_hidden
from surgicai_vision.core.errors import (
    InputError,
    check_at_least,
    check_finite,
    check_positive,
)
from surgicai_vision.evaluation.hierarchical_config import ORDER, HierarchicalConfig
from surgicai_vision.rl.settings import LEAST_BATCH

DECISIONS = 1500
"""Decisions to learn from, by default."""
SAVE_EVERY = 500
"""Decisions between training states, by default."""


@final
@dataclass(frozen=True)
class HighLevelSettings:
    """Settings of PPO over low-level policies; the paper names only the algorithm.

    Attributes:
        hidden: width of each hidden layer of actor and critic.
        learning_rate: Adam's learning rate.
        gamma: discount per decision.
        rollout: decisions between updates.
        batch_size: decisions per gradient step.
        epochs: passes over a rollout.
        entropy: weight of the entropy bonus.
    """

    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 1e-3
    gamma: float = 0.9
    rollout: int = 50
    batch_size: int = 50
    epochs: int = 10
    entropy: float = 0.01

    def __post_init__(self) -> None:
        check_positive(learning_rate=self.learning_rate, epochs=self.epochs)
        check_finite(learning_rate=self.learning_rate, entropy=self.entropy)
        check_at_least(LEAST_BATCH, rollout=self.rollout, batch_size=self.batch_size)
        if not 0 < self.gamma < 1 or self.entropy < 0:
            raise InputError(
                f"gamma is {self.gamma}, entropy {self.entropy}; allowed: between 0 and 1, and at "
                "least 0."
            )
        check_hidden(self.hidden)


@final
@dataclass(frozen=True)
class HighLevelRequest:
    """Everything that decides what PPO learns.

    Attributes:
        low: the low-level policies, fixed; `hlp: order` and `termination: privileged`.
        decisions: decisions to learn from.
        settings: PPO's settings.
        seed: seed of networks, decisions and starts.
        validation: episodes of the evaluation at each state, from validation starts.
        save_every: decisions between training states.
    """

    low: HierarchicalConfig
    decisions: int = DECISIONS
    settings: HighLevelSettings = field(default_factory=HighLevelSettings)
    seed: int = 0
    validation: int = 20
    save_every: int = SAVE_EVERY

    def __post_init__(self) -> None:
        if self.low.hlp != ORDER or self.low.termination != "privileged":
            raise InputError(
                f"hlp is {self.low.hlp}, termination {self.low.termination}; PPO needs a file "
                f"with hlp: {ORDER} and termination: privileged."
            )
        if self.decisions < 1 or self.save_every < 1 or self.validation < 0 or self.seed < 0:
            raise InputError(
                f"decisions is {self.decisions}, save_every {self.save_every}, validation "
                f"{self.validation}, seed {self.seed}; they must be at least 1, 1, 0 and 0."
            )
