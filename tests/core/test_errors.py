"""Errors: what the checks accept, and that messages state the given and the allowed values."""

import math
import pickle

import pytest

from surgicai_vision.core.errors import (
    InputError,
    SurgicaiError,
    UnknownName,
    check_at_least,
    check_at_most,
    check_finite,
    check_positive,
)
from surgicai_vision.core.plugins import NameCollision


def test_numbers_at_the_limit_and_no_number_pass():
    check_at_least(1, episodes=1, size=224, epochs=None)
    check_at_least(0, **{"condition dark: episodes": 0})
    check_at_most(1, share=1.0, episodes=None)
    check_finite(noise=1e300)
    check_positive(learning_rate=1e-9)


@pytest.mark.parametrize("number", [0, -1, math.nan])
def test_the_number_that_is_wrong_is_named(number):
    with pytest.raises(InputError, match=f"^size is {number}; it must be at least 1.$"):
        check_at_least(1, episodes=2, size=number)
    with pytest.raises(InputError, match=f"^size is {number}; it must be above 0.$"):
        check_positive(episodes=2, size=number)


@pytest.mark.parametrize("number", [math.inf, math.nan])
def test_a_number_that_is_not_finite_is_named(number):
    with pytest.raises(InputError, match=f"^noise is {number}; give a finite number.$"):
        check_finite(size=1.0, noise=number)
    with pytest.raises(InputError, match=f"^noise is {number}; it must be at most 9.$"):
        check_at_most(9, size=1, noise=number)


@pytest.mark.parametrize(
    "error",
    [
        SurgicaiError("It failed."),
        UnknownName("camera", "frnt", ["front", "back"]),
        NameCollision("task", "knot", "one", "other"),
    ],
)
def test_an_error_crosses_processes(error):
    error.add_note("where it happened")
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), copy.exit_code) == (type(error), str(error), error.exit_code)
    assert copy.__notes__ == ["where it happened"]
