"""Checks of a training whose dataset is not made yet: what would fail after hours of work."""

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.experiments.dataset_config import DatasetConfig
from surgicai_vision.features.encoders import POOLS
from surgicai_vision.rl.algorithms import LEARNED
from surgicai_vision.training import policies
from surgicai_vision.training.run_config import RunConfig


def check_training(run: RunConfig, dataset: DatasetConfig, subtask: str | None) -> None:
    """Refuse a policy that cannot be trained on what a dataset will hold, before it is recorded.

    Args:
        run: what is trained.
        dataset: what it is trained on.
        subtask: train on this subtask's frames of whole procedures.

    Raises:
        UnknownName: a recipe, a change of one, or a pool that does not exist.
        InputError: demonstrations of which nothing is rendered, a policy that only an algorithm
            trains, a recipe with progress as an input or with frames that the dataset does not
            hold, or an ablation of one that is not read, looks that are held out for tests, or a
            dataset of one subtask where whole procedures are needed.
    """
    check_name("pool", run.pool, POOLS)
    if not dataset.demonstrations.view:
        raise InputError(
            f"demonstrations {dataset.demonstrations.name}: a policy is trained on them, and view "
            "is empty, so that no dataset is made of them; give at least one view."
        )
    _check_looks(run, dataset)
    if run.by_lerobot_train:
        if dataset.demonstrations.frame_stride > 1:
            raise InputError(
                f"policy: lerobot-train needs a frame of every step for '{run.policy}', and "
                f"frame_stride is {dataset.demonstrations.frame_stride}; leave frame_stride out."
            )
        if run.changes or run.recipe != RunConfig.recipe:
            raise InputError(
                f"policy: lerobot-train reads no recipe for '{run.policy}', so that an ablation of "
                "it would change nothing; leave recipe and change out of ablation, or give "
                f"policy: {run.policy} in a plan."
            )
        return
    if run.policy in LEARNED:
        raise InputError(
            f"policy: '{run.policy}' is what an algorithm trains; write `algo:` instead "
            "(docs/rl.md)."
        )
    recipe = policies.recipe_of(run)
    policies.check_progress_from(recipe, None)
    learned = subtask or dataset.env.task
    policies.check_retries(recipe, learned, dataset.demonstrations.demonstrator)
    held = _held(dataset)
    if recipe.frame_stride % held:
        raise InputError(
            f"recipe {run.recipe_label} uses a frame every {recipe.frame_stride} steps, and the "
            f"dataset will hold one every {held}; change one frame_stride so that the recipe's "
            "is a multiple of the dataset's."
        )
    whole = dataset.env.task == names.SUTURE
    if subtask and not whole:
        raise InputError(
            f"subtask: '{subtask}' is taken from whole procedures, and the demonstrations are of "
            f"'{dataset.env.task}'; leave subtask out, or name demonstrations of '{names.SUTURE}'."
        )
    if policies.policy_plugin(run.policy).target == names.STAGE and not whole:
        raise InputError(
            f"policy: '{run.policy}' learns which subtask is due from whole procedures, and the "
            f"demonstrations are of '{dataset.env.task}'; name demonstrations of '{names.SUTURE}'."
        )


def _held(dataset: DatasetConfig) -> int:
    """Return the control steps from frame to frame, by the dataset's frames per second.

    These are rounded down; `dataset.subset` computes with them too.
    """
    spacing = dataset.demonstrations.frame_stride * dataset.env.action_repeat
    return names.FPS // max(names.FPS // spacing, 1)


def _check_looks(run: RunConfig, dataset: DatasetConfig) -> None:
    """Refuse to learn from looks that are held out for tests."""
    shown = dataset.demonstrations.shown(dataset.env)
    if run.views and shown.randomisation.shows_heldout:
        raise InputError(
            f"demonstrations of '{dataset.env.task}' would show looks that are held out for tests "
            f"({', '.join(names.HELDOUT_APPEARANCES)}); use appearance: {names.TRAIN} and no "
            "appearance_shift."
        )
