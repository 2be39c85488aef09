"""Instructions: several sentences per task; held-out ones are never used in training."""

import itertools

import pytest

from surgicai_vision.core import names
from surgicai_vision.core.errors import UnknownName
from surgicai_vision.core.instructions import (
    HELDOUT,
    INSTRUCTION_BANKS,
    PARAPHRASES,
    STANDARD,
    TRAIN,
    draw_instruction,
    instructions,
)


@pytest.mark.parametrize("task", names.TASK_TEXTS)
def test_held_out_sentences_are_no_others(task: str) -> None:
    train, heldout = instructions(task, TRAIN), instructions(task, HELDOUT)
    assert instructions(task) == (names.TASK_TEXTS[task],) == train[:1]
    assert len({*train, *heldout}) == len(train) + len(heldout)
    assert all(text[0].isupper() and text.endswith(".") for text in (*train, *heldout))


def test_no_sentence_tells_two_tasks() -> None:
    told = [text for texts in PARAPHRASES.values() for text in itertools.chain(*texts)]
    told += names.TASK_TEXTS.values()
    assert len(set(told)) == len(told)
    # Every sentence of the two tasks that differ in the arm names it: a policy must read it.
    for task, side in (("grasp", "right"), ("handoff", "left")):
        for text in (*instructions(task, TRAIN), *instructions(task, HELDOUT)):
            assert side in text and {"right": "left", "left": "right"}[side] not in text


def test_a_seed_draws_the_same_sentence() -> None:
    drawn = [draw_instruction("place", TRAIN, seed) for seed in range(60)]
    assert drawn == [draw_instruction("place", TRAIN, seed) for seed in range(60)]
    assert set(drawn) == set(instructions("place", TRAIN))
    assert {draw_instruction("place", STANDARD, seed) for seed in range(9)} == {
        names.TASK_TEXTS["place"]
    }
    with pytest.raises(UnknownName, match=INSTRUCTION_BANKS[0]):
        instructions("place", "standart")
