"""Banks of starts: each seed belongs to one bank, and demonstrations use training starts only."""

import pytest

from surgicai_vision.core.banks import (
    BANKS,
    HELD_OUT,
    TRAINING,
    VALIDATION,
    bank_of,
    check_training_starts,
)
from surgicai_vision.core.errors import InputError
from surgicai_vision.experiments.dataset_config import (
    SEEDS_EACH,
    TRAINING_SEEDS,
    first_seed,
)
from surgicai_vision.training.run_config import Starts


def test_every_seed_belongs_to_one_bank():
    told = [bank_of(seed) for seed in (0, 499_999, 500_000, 899_999, 900_000, 5_000_000)]
    assert told == [TRAINING, TRAINING, VALIDATION, VALIDATION, HELD_OUT, HELD_OUT]
    assert Starts().bank == bank_of(BANKS["test"]) == HELD_OUT
    assert bank_of(BANKS["validation"]) == VALIDATION
    assert Starts(899_999, 2).bank == VALIDATION, "across banks what the least independent is"


def test_demonstrations_begin_from_training_starts():
    check_training_starts(499_998, 2)
    last = first_seed(TRAINING_SEEDS - 1)
    check_training_starts(last, SEEDS_EACH)  # the highest seeds of any plan
    for seed, episodes in ((499_999, 2), (500_000, 1), (900_000, 1), (0, 900_000)):
        with pytest.raises(InputError, match=f"seed {seed} on, {episodes} of them"):
            check_training_starts(seed, episodes)
