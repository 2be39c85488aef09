"""The whole state of a numpy generator, as plain data.

`bit_generator.state` alone does not say what `Generator.spawn` returns next: children are drawn
from the generator's seed sequence, which counts them.
"""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np


def generator_state(generator: np.random.Generator) -> dict[str, object]:
    """Return everything that `generator` and the children it spawns depend on, fit for JSON."""
    seeds = cast(np.random.SeedSequence, generator.bit_generator.seed_seq)
    return {"bits": dict(generator.bit_generator.state), "seeds": dict(seeds.state)}


def generator_of(state: Mapping[str, Any]) -> np.random.Generator:
    """Return a new generator in a state from `generator_state`; its bits are PCG64's."""
    bits = np.random.PCG64(np.random.SeedSequence(**state["seeds"]))
    bits.state = state["bits"]
    return np.random.Generator(bits)
