"""Shifts: how far the axes of `robustness` go at strength 1, as fields of `RandomisationConfig`.

`WORLD` holds the axes that change the world. Those of `RENDERED` can also be drawn for a
demonstration that was recorded without them: cameras and lights do not move what was recorded, and
joints that are off change only what the arm reports. (The recorded actions stay: with the base
joints off by 5° they are turned by as much.)
"""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType

from surgicai_vision.core.config import RANDOMISATION_LIMITS, RandomisationConfig, from_mapping

WORLD: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "camera": {"camera_shift": 10.0, "camera_turn": 10.0},
        "field_of_view": {"camera_fovy": 10.0},
        "light": {"light": 0.8},
        "tint": {"colour": 0.8},
        "tissue": {"appearance_shift": 1.0},
        "distractors": {"distractors": 5},
        "latency": {"latency": 5},
        "kinematic_error": {"kinematic_error": 1.0},
        "needle": {"needle_size": 0.2, "needle_thickness": 0.3},
        "robot_start": {"robot_start": 15.0},
    }
)
"""Axis → field of `RandomisationConfig` → what strength 1 adds to it. The largest kinematic error
is that of the surgical robotics challenge; the others are ours: at strength 1 the plain image is
only just recognisable."""
RENDERED: Mapping[str, float] = MappingProxyType(
    {
        name: size
        for axis in ("camera", "field_of_view", "light", "tint", "kinematic_error")
        for name, size in WORLD[axis].items()
    }
)
"""The same for the axes, all at once, that can be drawn when a demonstration is rendered."""


def added(
    randomisation: RandomisationConfig, sizes: Mapping[str, float], strength: float
) -> RandomisationConfig:
    """Return a randomisation with `strength` of some sizes added to it, up to its limits.

    Args:
        randomisation: what varies anyway.
        sizes: its field → what strength 1 adds.
        strength: 0 (nothing is added) to 1.
    """
    table = dataclasses.asdict(randomisation)
    for name, size in sizes.items():
        own = table[name]
        value = min(own + strength * size, RANDOMISATION_LIMITS[name])
        table[name] = math.floor(value + 0.5) if isinstance(own, int) else value
    return from_mapping(RandomisationConfig, table)
