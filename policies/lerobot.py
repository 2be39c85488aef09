"""`act`, `diffusion`, `vqbet`: LeRobot's policies that plan chunks, on frozen features.

    surgicai-vision train --task handoff --policy act --encoder imagenet-lite-early --pool spatial

The networks are LeRobot's and are in the distribution `lerobot_env_surgicai`
(`lerobot_env_surgicai.chunk_policies`). It is imported only when a policy is built: LeRobot's
import takes ten seconds, and commands that only name a policy start without it. This module defines
the names, what a recipe must have, and which actions each policy learns from.
"""

import contextlib
import functools
import importlib
import io
from collections.abc import Mapping

from policies.base import Plugin, Policy, Recipe
from policies.chunks import ChunkRecipe, planned_offsets
from surgicai_vision.core import names
from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError, check_positive, first_line

ADAPTER = "lerobot_env_surgicai.chunk_policies"
DOWN_DIMS = (512, 1024, 2048)
"""LeRobot's `DiffusionConfig.down_dims`, for a recipe that sets none."""
NOISE_LEVELS = 100
"""LeRobot's `DiffusionConfig.num_train_timesteps`, for a recipe that sets none."""
PREDICTED_TOKENS = 3
"""LeRobot's `VQBeTConfig.n_action_pred_token`, for a recipe that sets none."""
UNFIT = (
    *(AssertionError, ArithmeticError, LookupError),
    *(RuntimeError, TypeError, ValueError),
)
"""What LeRobot and torch raise for settings with which a network cannot be built."""


def horizon(recipe: ChunkRecipe) -> int:
    """Return how many actions the U-Net denoises: chunk and history, rounded up to halve evenly."""
    widths = recipe.settings.get("down_dims", DOWN_DIMS)
    if not isinstance(widths, list | tuple):
        raise InputError(f"settings: down_dims is {widths}; it must be a list of widths.")
    halvings: int = 2 ** len(widths)
    return -(-(recipe.chunk + recipe.history - 1) // halvings) * halvings


def _check_sampling(settings: Mapping[str, JSON]) -> None:
    """Refuse settings with which a policy can be trained but cannot plan."""
    levels = settings.get("num_train_timesteps", NOISE_LEVELS)
    steps = settings.get("num_inference_steps")
    if isinstance(levels, int) and isinstance(steps, int) and not 1 <= steps <= levels:
        raise InputError(
            f"settings: num_inference_steps is {steps}; allowed: 1 to num_train_timesteps, "
            f"{levels}."
        )
    temperature = settings.get("bet_softmax_temperature")
    if isinstance(temperature, int | float):
        check_positive(**{"settings: bet_softmax_temperature": temperature})


def _make(kind: str, recipe: Recipe, visual: tuple[tuple[int, ...], ...]) -> Policy:
    """Return an untrained policy of the adapter's class `kind`."""
    assert isinstance(recipe, ChunkRecipe)
    _check_sampling(recipe.settings)
    try:
        adapter = importlib.import_module(ADAPTER)
    except ImportError as error:
        raise InputError(
            f"LeRobot's policies need the distribution lerobot_env_surgicai ({error}); install "
            "it alongside surgicai-vision."
        ) from None
    try:
        # VQ-BeT prints its size to stdout, where --json prints.
        with contextlib.redirect_stdout(io.StringIO()):
            policy: Policy = vars(adapter)[kind](recipe, visual)
    except UNFIT as error:
        # LeRobot and torch check the settings of a network as they build it.
        raise InputError(
            f"LeRobot's {kind} cannot be made with these settings ({first_line(error)})."
        ) from error
    return policy


def _diffusion_offsets(recipe: Recipe) -> range:
    """Return offsets that begin one step back per earlier observation, as in LeRobot."""
    assert isinstance(recipe, ChunkRecipe)
    return range(1 - recipe.history, 1 - recipe.history + horizon(recipe))


def _vqbet_offsets(recipe: Recipe) -> range:
    """Return offsets with a chunk for each moment seen and for each further predicted token."""
    assert isinstance(recipe, ChunkRecipe)
    tokens = recipe.settings.get("n_action_pred_token", PREDICTED_TOKENS)
    if not isinstance(tokens, int):
        raise InputError(f"settings: n_action_pred_token is {tokens}; it must be a whole number.")
    return range(1 - recipe.history, tokens + recipe.chunk - 1)


ACT = Plugin(
    "act", ChunkRecipe, functools.partial(_make, "Act"), names.ACTION_CHUNK, planned_offsets
)
DIFFUSION = Plugin(
    "diffusion",
    ChunkRecipe,
    functools.partial(_make, "Diffusion"),
    names.ACTION_CHUNK,
    _diffusion_offsets,
)
VQBET = Plugin(
    "vqbet", ChunkRecipe, functools.partial(_make, "VqBet"), names.ACTION_CHUNK, _vqbet_offsets
)
