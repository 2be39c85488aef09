"""Axes: what can shift, and how far strength 1 goes. A new axis is one entry of `AXES`.

An axis changes the world, by the randomisation the env already has (`config.RandomisationConfig`),
or only the images the agent is given (`core.corruption`); `all` applies every axis at once, and
`all-but-noise`, an ablation of it, every axis but the noise. In the world, every episode draws its
own shift from its seed, uniform in ± the axis's size; the strength scales the size. The shift is
added to the task's own randomisation of the axis.

At strength 1 a person can only just recognise the scene; `surgicai-vision scene --axes FILE` draws
every axis at every strength.
"""

import dataclasses
import functools
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.core.shifts import WORLD, added
from surgicai_vision.evaluation.agent import Agent, MakeAgent
from surgicai_vision.training.run_config import Shift, evaluated_in

if TYPE_CHECKING:
    from surgicai_vision.evaluation.policy_spec import PolicySpec
from surgicai_vision.core.corruption import CORRUPTIONS
from surgicai_vision.evaluation.robustness.corrupted_agent import CorruptedAgent


@dataclass(frozen=True)
class Axis:
    """What shifts at strength 1.

    Attributes:
        text: what it is, in words.
        world: field of `config.RandomisationConfig` → what is added to it.
        images: keys of `core.corruption.CORRUPTIONS`, in the order in which they are applied.
        seen: whether it changes only images, so that a policy without images is unaffected.
    """

    text: str
    world: Mapping[str, float] = MappingProxyType({})
    images: tuple[str, ...] = ()
    seen: bool = True


ALL = "all"
"""The axis along which everything shifts at once, each by the same strength."""
SINGLE: Mapping[str, Axis] = MappingProxyType(
    {
        "camera": Axis(
            "cameras off by ±10 mm and ±10° about each axis",
            WORLD["camera"],
        ),
        "field_of_view": Axis("vertical field of view off by ±10°", WORLD["field_of_view"]),
        "light": Axis("brightness of each light off by ±80 %", WORLD["light"]),
        "tint": Axis("colour channels of tissue and surroundings off by ±80 %", WORLD["tint"]),
        "tissue": Axis(
            "tissue, drape, needle, instruments and light all look as in a held-out family",
            WORLD["tissue"],
        ),
        "distractors": Axis(
            "up to 5 objects lie around: a second needle, gauze, a clip, cut thread, blood",
            WORLD["distractors"],
        ),
        "smoke": Axis(
            "drifting grey smoke that hides 40 to 90 % of what lies behind it", images=("smoke",)
        ),
        "blur": Axis(
            "Gaussian blur, standard deviation 1/56 of the image's height", images=("blur",)
        ),
        "noise": Axis(
            "Gaussian pixel noise, standard deviation 64 of 255 grey levels", images=("noise",)
        ),
        "latency": Axis(
            "actions take effect 5 control steps (100 ms) later", WORLD["latency"], seen=False
        ),
        "kinematic_error": Axis(
            "first three joints off by ±5°, ±5°, ±5 mm, unknown to the arm",
            WORLD["kinematic_error"],
            seen=False,
        ),
        "needle": Axis(
            "radius of the needle's arc off by ±20 %, its thickness by ±30 %",
            WORLD["needle"],
            seen=False,
        ),
        "robot_start": Axis(
            "both arms' tips start off by ±15 mm along each axis", WORLD["robot_start"], seen=False
        ),
    }
)
"""The thirteen axes that shift one thing each."""


def _together(text: str, names: Collection[str]) -> Axis:
    """Return the axis along which several axes shift at once."""
    parts = [SINGLE[name] for name in SINGLE if name in names]
    return Axis(
        text,
        {name: size for part in parts for name, size in part.world.items()},
        tuple(kind for part in parts for kind in part.images),
        seen=False,
    )


AXES: Mapping[str, Axis] = MappingProxyType(
    {**SINGLE, ALL: _together("everything above at once, each at this strength", SINGLE)}
)
"""Axis → what strength 1 means."""
SHIFTS: Mapping[str, Axis] = MappingProxyType(
    {
        **AXES,
        **{
            f"{ALL}-but-{name}": _together(f"everything at once but {name}", SINGLE.keys() - {name})
            for name in SINGLE
        },
    }
)
"""The axes, and the ablations of `ALL`: which axis costs most where everything shifts."""


def axes_of(spec: "PolicySpec") -> tuple[str, ...]:
    """Return the axes that can affect a policy; without images, only those not marked `seen`."""
    images = bool(spec.run.views)
    return tuple(name for name, axis in AXES.items() if images or not axis.seen)


def shifted(spec: "PolicySpec", axis: str, strength: float) -> "PolicySpec":
    """Return the policy with its world, or its images, shifted by `strength` along `axis`.

    Args:
        spec: what is evaluated in which task.
        axis: a key of `SHIFTS`.
        strength: 0 (nothing shifts) to 1.

    Raises:
        UnknownName, InputError: no such axis, or a strength out of its range.
    """
    check_name("axis", axis, SHIFTS)
    if not 0 <= strength <= 1:
        raise InputError(f"strength is {strength}; allowed: 0 to 1.")
    chosen = SHIFTS[axis]
    make = spec.make
    if spec.run.views:
        # The outermost agent, made last, sees the image first.
        for kind in reversed(chosen.images):
            make = functools.partial(_corrupted, make, kind, strength)
    env = shifted_config(spec.config, chosen, strength)
    run = evaluated_in(spec.run, env, Shift(axis, float(strength)))
    return dataclasses.replace(spec, run=run, make=make)


def shifted_config(config: TaskConfig, axis: Axis, strength: float) -> TaskConfig:
    """Return a task with `strength` of the axis added to its randomisation, up to its limits."""
    return dataclasses.replace(
        config, randomisation=added(config.randomisation, axis.world, strength)
    )


def _corrupted(make: MakeAgent, kind: str, strength: float) -> Agent:
    """Make an agent that sees through a corruption (in a worker process)."""
    return CorruptedAgent(make(), CORRUPTIONS[kind], strength)
