"""Looks: an episode's appearance and distractors, as numbers of its randomisation.

Both are always drawn, whichever is on. Each is an identity with a seed, from which everything
visible follows (`scene.visual.appearance`, `scene.visual.distractors`).
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig
from surgicai_vision.scene.visual.appearance import SEEDS, Appearance
from surgicai_vision.scene.visual.distractors import MOST, Litter


def draw(config: RandomisationConfig, rng: np.random.Generator) -> Mapping[str, tuple[float, ...]]:
    """Draw only a look: axis → its numbers, for the axes that are on in `config`."""
    drawn = {
        "appearance": draw_appearance(config, rng).numbers[:2],
        "distractors": draw_litter(config, rng).numbers,
    }
    return {axis: numbers for axis, numbers in drawn.items() if axis in config.on}


def draw_appearance(config: RandomisationConfig, rng: np.random.Generator) -> Appearance:
    """Draw one episode's appearance; `config` does not change how many random numbers it uses."""
    one = _draw(config.appearance, rng)
    other = _draw(names.HELDOUT if config.appearance_shift else "", rng)
    return dataclasses.replace(
        one, share=config.appearance_shift, other=other.family, other_seed=other.seed
    )


def _draw(families: str, rng: np.random.Generator) -> Appearance:
    """Draw an appearance of a family or a set of families; "" gives the plain one."""
    share = float(rng.uniform())
    seed = int(rng.integers(SEEDS))
    if not families:
        return Appearance()
    chosen = names.APPEARANCE_SETS.get(families, (families,))
    return Appearance(chosen[int(share * len(chosen))], seed)


def draw_litter(config: RandomisationConfig, rng: np.random.Generator) -> Litter:
    """Draw the distractors of one episode: up to `config.distractors` objects."""
    share = float(rng.uniform())
    seed = int(rng.integers(SEEDS))
    count = min(int(share * (config.distractors + 1)), MOST)
    return Litter(count, seed if count else 0)
