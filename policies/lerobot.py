"""`act`, `diffusion`, `vqbet`: policies of LeRobot that plan chunks, on frozen features.

    surgicai-vision train --task handoff --policy act --encoder imagenet-lite-early --pool spatial

The networks are LeRobot's and stand in the distribution `lerobot_env_surgicai`
(`lerobot_env_surgicai.chunk_policies`), which is imported when one is made: LeRobot's import takes
ten seconds, and what only names a policy starts without it. Here stand their names, what a recipe
must have, and which actions each learns from.
"""

import functools
import importlib

from policies.base import Plugin, Policy, Recipe
from policies.chunks import ChunkRecipe
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError

ADAPTER = "lerobot_env_surgicai.chunk_policies"
DOWN_DIMS = (512, 1024, 2048)
"""LeRobot's `DiffusionConfig.down_dims` where a recipe has none."""
PREDICTED_TOKENS = 3
"""LeRobot's `VQBeTConfig.n_action_pred_token` where a recipe has none."""


def horizon(recipe: ChunkRecipe) -> int:
    """Return how many actions the U-Net denoises: chunk and history, rounded up to its halvings."""
    widths = recipe.settings.get("down_dims", DOWN_DIMS)
    if not isinstance(widths, list | tuple):
        raise InputError(f"settings: down_dims is {widths}; it must be a list of widths.")
    halvings: int = 2 ** len(widths)
    return -(-(recipe.chunk + recipe.history - 1) // halvings) * halvings


def _make(kind: str, recipe: Recipe, visual: tuple[tuple[int, ...], ...]) -> Policy:
    """Return an untrained policy of the adapter's class `kind`."""
    try:
        adapter = importlib.import_module(ADAPTER)
    except ImportError as error:
        raise InputError(
            f"LeRobot's policies need the distribution lerobot_env_surgicai ({error}); "
            "install it beside surgicai-vision."
        ) from None
    policy: Policy = vars(adapter)[kind](recipe, visual)
    return policy


def _act_offsets(recipe: Recipe) -> range:
    assert isinstance(recipe, ChunkRecipe)
    return range(recipe.chunk)


def _diffusion_offsets(recipe: Recipe) -> range:
    """Begin as LeRobot does, one step back for each earlier observation."""
    assert isinstance(recipe, ChunkRecipe)
    return range(1 - recipe.history, 1 - recipe.history + horizon(recipe))


def _vqbet_offsets(recipe: Recipe) -> range:
    """Hold a chunk for each moment that is seen and for each token that is predicted besides."""
    assert isinstance(recipe, ChunkRecipe)
    tokens = recipe.settings.get("n_action_pred_token", PREDICTED_TOKENS)
    if not isinstance(tokens, int):
        raise InputError(f"settings: n_action_pred_token is {tokens}; it must be a whole number.")
    return range(1 - recipe.history, tokens + recipe.chunk - 1)


ACT = Plugin("act", ChunkRecipe, functools.partial(_make, "Act"), names.ACTION_CHUNK, _act_offsets)
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
