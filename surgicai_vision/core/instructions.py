"""Instructions: each task in several sentences, for policies that read language.

* `instructions(task, bank)`: the sentences of a bank: "standard" (the one that datasets store),
  "train" (it and its paraphrases for training), "heldout" (paraphrases for tests only).
* `draw_instruction(task, bank, seed)`: one of them, by an episode's seed.

A paraphrase names the same goal, arm and part of the needle as the standard sentence. LIBERO-like
benchmarks give one sentence per task, which a policy may use as a task number; held-out sentences
show whether it reads the text. A task of another distribution has only its own sentence.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from surgicai_vision.core.errors import check_name
from surgicai_vision.core.tasks import task_text

STANDARD = "standard"
TRAIN = "train"
HELDOUT = "heldout"
INSTRUCTION_BANKS = (STANDARD, TRAIN, HELDOUT)

PARAPHRASES: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = MappingProxyType(
    {
        "grasp": (
            (
                "Pick up the needle with the right instrument.",
                "Take hold of the needle using the right-hand tool.",
                "Use the right arm to grip the suture needle.",
                "Close the right-hand gripper on the needle.",
            ),
            (
                "With the tool on the right, seize the needle.",
                "The needle lies there: get it into the jaws of the right arm.",
            ),
        ),
        "place": (
            (
                "Bring the needle's tip to the entry point at a right angle to the tissue.",
                "Position the needle tip on the entry mark, perpendicular to the surface.",
                "Move the tip of the needle to where it is to enter, upright on the tissue.",
                "Set the needle tip at the entry hole, square to the tissue.",
            ),
            (
                "Get ready to pierce: tip at the entry, needle square to the surface.",
                "Hold the needle's point over the entry mark, at ninety degrees to the tissue.",
            ),
        ),
        "insert": (
            (
                "Push the needle through the tissue until the tip comes out of the exit.",
                "Pass the needle through the tissue so that its tip leaves the exit point.",
                "Advance the needle along its arc until its point emerges at the exit.",
                "Pierce the tissue with the needle from the entry to the exit.",
            ),
            (
                "Take the bite: in at the entry, out at the exit.",
                "Rotate the needle on through until you see its tip at the exit mark.",
            ),
        ),
        "handoff": (
            (
                "Grip the needle near its tip with the left instrument.",
                "Take the tip side of the needle with the left-hand tool.",
                "Use the left arm to grasp the needle behind its tip.",
                "Close the left-hand gripper on the needle's tip end.",
            ),
            (
                "Let the tool on the left catch the needle where it comes out.",
                "With the left arm, seize the end of the needle that has emerged.",
            ),
        ),
        "pullout": (
            (
                "Draw the needle completely out of the tissue to the end point.",
                "Extract the whole needle and bring it to the end point.",
                "Pull the needle out of the tissue and carry it to the end point.",
                "Remove the needle fully from the tissue, up to the end point.",
            ),
            (
                "Free the needle of the tissue and take it to the end point.",
                "Out with all of the needle, as far as the end point.",
            ),
        ),
        "suture": (
            (
                "Place one stitch: pick up the needle, drive it through and pull it out.",
                "Make a single stitch from grasping the needle to pulling it out.",
            ),
            ("Suture once, from the needle on the tissue to the needle pulled through.",),
        ),
    }
)
"""Task → its paraphrases for training, and those for tests only; written for this project."""


def instructions(task: str, bank: str = STANDARD) -> tuple[str, ...]:
    """Return the sentences of a task.

    Raises:
        UnknownName: no such bank, or no such task.
    """
    check_name("bank of instructions", bank, INSTRUCTION_BANKS)
    standard = (task_text(task),)
    train, heldout = PARAPHRASES.get(task, ((), ()))
    if bank == HELDOUT:
        return heldout or standard
    return standard if bank == STANDARD else (*standard, *train)


def draw_instruction(task: str, bank: str, seed: int) -> str:
    """Return a sentence of a task, drawn by an episode's seed."""
    sentences = instructions(task, bank)
    generator = np.random.default_rng((seed, len(sentences)))
    return sentences[int(generator.integers(len(sentences)))]
