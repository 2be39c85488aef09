"""Banks of starts: what a start is for, by its seed.

Demonstrations and reinforcement learning begin from training starts, choices are made on validation
starts, and results are measured on held-out ones. The banks never overlap.

    bank_of(900_000) == HELD_OUT
"""

from collections.abc import Mapping
from types import MappingProxyType

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError

BANKS: Mapping[str, int] = MappingProxyType(
    {"test": names.TEST_SEED, "validation": names.VALIDATION_SEED}
)
"""Bank of an evaluation's starts, as a grid names it → its first seed."""

HELD_OUT, VALIDATION, TRAINING = "held-out", "validation", "training"
"""What a start may be for a policy."""

USES: Mapping[str, str] = MappingProxyType(
    {
        HELD_OUT: "the bank for tests: no training uses it",
        VALIDATION: "the bank for validation: choices are made on it",
        TRAINING: "the bank for training: demonstrations begin from it",
    }
)
"""What each bank is for, in words."""


def bank_of(seed: int) -> str:
    """Return what a start is for a policy: `HELD_OUT`, `VALIDATION` or `TRAINING`."""
    if seed >= names.TEST_SEED:
        return HELD_OUT
    return VALIDATION if seed >= names.VALIDATION_SEED else TRAINING


def check_training_starts(seed: int, episodes: int) -> None:
    """Refuse to demonstrate from starts that are kept for validation or for tests.

    Args:
        seed: of the first start.
        episodes: least number of starts, each with the next seed.

    Raises:
        InputError: a start is not a training start.
    """
    if bank_of(seed + episodes - 1) != TRAINING:
        raise InputError(
            f"Demonstrations from seed {seed} on, {episodes} of them, reach into the starts that "
            f"are reserved for validation (from {names.VALIDATION_SEED} on) or for tests (from "
            f"{names.TEST_SEED} on); give a smaller --seed."
        )
