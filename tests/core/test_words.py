"""Words: one thing is not "1 things"."""

from surgicai_vision.core.words import noun, plural


def test_one_is_singular_and_every_other_number_plural():
    assert [plural(count, "run") for count in (0, 1, 2)] == ["0 runs", "1 run", "2 runs"]
    assert (noun(1, "episode"), noun(0, "episode")) == ("episode", "episodes")
