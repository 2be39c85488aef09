"""Policies by name (other distributions can add theirs), their recipes, and loading checkpoints.

* `load_recipe(policy, recipe, changes) -> recipe object`: the frozen settings of a policy from
  configs/recipes, with changes.
* `load_policy(folder) -> policy` from a checkpoint folder; `policy.checkpoint` describes it.
* `load_encoder_of(checkpoint, …)`: the encoder a policy was trained on, verified.
"""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, cast

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, check_name, shown
from surgicai_vision.core.files import configs_folder, read_yaml
from surgicai_vision.core.plugins import POLICIES_GROUP, Registry, instance_of, resolve, uncallable
from surgicai_vision.demos.demonstrator import GOAL_FREE_DEMONSTRATORS
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource, load_encoder
from surgicai_vision.training import released
from surgicai_vision.training.checkpoint import (
    Checkpoint,
    check_encoder,
    read_checkpoint,
    read_tensors,
)
from surgicai_vision.training.run_config import ACTED_BY, BUDGET, RunConfig

if TYPE_CHECKING:
    from encoders.base import Encoder
    from policies.base import Plugin, Policy, Recipe

_is_plugin = instance_of("policies.base:Plugin")
_is_policy = instance_of("policies.base:Policy")


def _fault(part: object) -> str:
    """Return what is wrong with an object offered as a policy, "" if nothing."""
    if fault := _is_plugin(part):
        return fault
    plugin = cast("Plugin", part)
    recipe: object = plugin.recipe
    if not isinstance(recipe, type) or not dataclasses.is_dataclass(recipe):
        return f"has a recipe that is {shown(recipe)}; it must be a frozen dataclass"
    given = {field.name for field in dataclasses.fields(recipe)}
    asked = {field.name for field in dataclasses.fields(resolve("policies.base:Recipe"))}
    if missing := sorted(asked - given):
        return f"has a recipe without {', '.join(missing)}; derive it from policies.base.Recipe"
    return uncallable(plugin, "make")


POLICIES: Final = Registry["Plugin"](
    "policy",
    POLICIES_GROUP,
    {
        "bc": "policies.bc:BC",
        "bc-chunk": "policies.bc_chunk:BC_CHUNK",
        "hlp": "policies.hlp:HLP",
        "actor": "policies.actor:ACTOR",
        "bcq": "policies.actor:BCQ",
        "residual": "policies.residual:RESIDUAL",
        "act": "policies.lerobot:ACT",
        "diffusion": "policies.lerobot:DIFFUSION",
        "vqbet": "policies.lerobot:VQBET",
    },
    _fault,
)
"""Policy name → its `policies.base.Plugin`."""
ROWS: Final = 2
"""Observations on which a policy from another distribution is tested when it is built."""
UNCHANGED: Final[Mapping[str, JSON]] = MappingProxyType({})
"""No changes: a recipe as it is, or a policy that acts by its own."""


def register_policy(name: str, plugin: "Plugin", distribution: str = "") -> None:
    """Offer a policy under a new name in this process; see `Registry.register`.

    Raises:
        NameCollision: the name is taken.
        InputError: this is not a policy plug-in.
    """
    POLICIES.register(name, plugin, distribution)


def policy_names() -> tuple[str, ...]:
    """Return every registered policy name."""
    return POLICIES.names()


def policy_plugin(name: str) -> "Plugin":
    """Import the policy plug-in of `name`; `UnknownName` lists what exists.

    A plug-in from another distribution has this name whatever its author calls it, since a
    checkpoint names its policy by it. What it builds is checked: it must be a `Policy` that returns
    actions.
    """
    plugin = POLICIES.load(name)
    if POLICIES.is_ours(name):
        return plugin
    make = functools.partial(_made, name, plugin)
    return dataclasses.replace(plugin, name=name, make=make)


def _made(
    name: str, plugin: "Plugin", recipe: "Recipe", visual: tuple[tuple[int, ...], ...]
) -> "Policy":
    """Build a policy from another distribution.

    Raises:
        InputError: its code fails, or the result is not a policy that returns actions.
    """
    with POLICIES.calling(name):
        policy = plugin.make(recipe, visual)
    if fault := _is_policy(policy):
        raise POLICIES.refusal(name, f"makes what {fault}")
    if plugin.target == names.ACTION and policy.history == 1:
        with POLICIES.calling(name):
            shape = _answer_shape(policy)
        if shape != (ROWS, len(names.ACTION_NAMES)):
            raise POLICIES.refusal(
                name,
                f"gives answers of shape {shape} for {ROWS} observations; an action has "
                f"{len(names.ACTION_NAMES)} values, so it must be "
                f"({ROWS}, {len(names.ACTION_NAMES)})",
            )
    return policy


def _answer_shape(policy: "Policy") -> tuple[int, ...]:
    """Return the shape of a policy's answers to `ROWS` observations, without side effects."""
    import torch  # the policy has imported it

    was_training = policy.training
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        shape = tuple(policy.eval()(torch.zeros(ROWS, policy.inputs.dim)).shape)
    policy.train(was_training)
    return shape


def recipe_names() -> tuple[str, ...]:
    """Return the names of the recipes in configs/recipes."""
    return tuple(sorted(path.stem for path in (configs_folder() / "recipes").glob("*.yaml")))


def default_recipe(policy: str) -> str:
    """Return the default recipe of a policy: the one with its name, else the paper's."""
    return policy if policy in recipe_names() else "paper"


def load_recipe(
    policy: str = "bc", recipe: str | Path = "paper", changes: Mapping[str, JSON] = UNCHANGED
) -> "Recipe":
    """Read a recipe and apply changes.

    Args:
        policy: one of `policy_names()`.
        recipe: a name of `recipe_names()`, or the path of a YAML file.
        changes: keys to replace; `settings.use_vae` is one entry of the table `settings`.

    Raises:
        UnknownName: a policy, recipe or key that does not exist.
        BadFile: a recipe file that cannot be read.
        InputError: a value that is not allowed, or an entry of a key that is not a table.
    """
    plugin = policy_plugin(policy)
    path = Path(recipe)
    if path.suffix not in (".yaml", ".yml"):
        check_name("recipe", str(recipe), recipe_names())
        path = (configs_folder() / "recipes") / f"{recipe}.yaml"
    values: Mapping[str, object] = read_yaml(path, may_be_empty=True)
    if "epochs" in changes and changes.get(BUDGET):
        raise InputError(
            f"epochs={changes['epochs']} and {BUDGET}={changes[BUDGET]} are given; give one."
        )
    if "epochs" in changes:  # an explicit number of epochs overrides the budget
        values = {key: value for key, value in values.items() if key != BUDGET}
    return from_mapping(plugin.recipe, _changed(values, changes), f"recipe {recipe}")


def _changed(values: Mapping[str, object], changes: Mapping[str, JSON]) -> dict[str, object]:
    """Return a recipe's values with changes to whole keys and to single entries of a table."""
    changed = dict(values)
    for key, value in changes.items():
        table, dot, entry = key.partition(".")
        if not dot:
            changed[key] = value
            continue
        entries = changed.get(table, {})
        if not isinstance(entries, Mapping) or not entry:
            raise InputError(f"change '{key}': {table} is not a table with such an entry.")
        changed[table] = {**entries, entry: value}
    return changed


def recipe_of(run: RunConfig) -> "Recipe":
    """Return the recipe of a run with its changes; the only place that combines them.

    Raises:
        UnknownName: a policy, recipe or key that does not exist.
        BadFile: a recipe file that cannot be read.
        InputError: a value that is not allowed.
    """
    return load_recipe(run.policy, run.recipe, run.recipe_changes)


def check_progress_from(recipe: "Recipe", progress_from: Path | None) -> None:
    """Refuse a recipe that feeds progress without a policy that predicts it, and vice versa."""
    if recipe.progress_input and progress_from is None:
        raise InputError(
            "The recipe uses progress as an input; give the policy that predicts it "
            "(--progress-from DIR)."
        )
    if progress_from is not None and not recipe.progress_input:
        raise InputError(
            "The recipe does not use progress as an input; leave --progress-from "
            f"{progress_from} out, or give --change progress_input=true (and clock=false)."
        )


def check_retries(recipe: "Recipe", task: str, demonstrator: str | None) -> None:
    """Refuse `retry_after` where no further attempts were demonstrated.

    Args:
        recipe: how the policy acts.
        task: what it does.
        demonstrator: who demonstrated it; None if unknown.
    """
    if not recipe.retry_after:
        return
    if task == "grasp" and demonstrator in (None, *GOAL_FREE_DEMONSTRATORS):
        return
    learned = f"'{task}'" if demonstrator is None else f"'{task}' from '{demonstrator}'"
    raise InputError(
        f"retry_after is {recipe.retry_after}, but the policy learns {learned}, which has no "
        "further attempts to go on to; it is for a grasp that was demonstrated by "
        f"{' or '.join(sorted(GOAL_FREE_DEMONSTRATORS))}."
    )


def load_policy(folder: Path | str, changes: Mapping[str, JSON] = UNCHANGED) -> "Policy":
    """Load a trained policy from a checkpoint folder or by its name `released:NAME`, verified.

    Args:
        folder: the checkpoint.
        changes: as in `restore`.

    Returns:
        The policy; `policy.checkpoint` describes it.

    Raises:
        BadFile: a folder that is not a complete checkpoint, or one that was changed.
        InputError: a released policy that does not exist, or one of another scene.
    """
    return restore(read_checkpoint(released.resolve(folder)), changes)


def restore(checkpoint: Checkpoint, changes: Mapping[str, JSON] = UNCHANGED) -> "Policy":
    """Build the trained policy of a checkpoint; see `load_policy`.

    Args:
        checkpoint: the checkpoint to restore.
        changes: recipe settings from `ACTED_BY` that replace its own when it acts.

    Raises:
        UnknownName: a setting that affects what is learned, or does not exist.
        InputError: a value that is not allowed, a setting of chunks for a policy without them, or
            retries for one that has learned no search.
    """
    plugin = policy_plugin(checkpoint.policy)
    for name in changes:
        check_name("setting by which a policy acts", name, ACTED_BY)
        if name not in plugin.recipe.__dataclass_fields__:
            raise InputError(
                f"'{checkpoint.policy}' answers with one action and has no {name} to change; "
                "only policies that plan chunks have one."
            )
    recipe = from_mapping(plugin.recipe, {**checkpoint.recipe, **changes})
    check_retries(recipe, checkpoint.task.task, checkpoint.run.demonstrator)
    try:
        policy = plugin.make(recipe, checkpoint.visual)
        policy.load_state_dict(read_tensors(checkpoint))
    except RuntimeError as error:
        raise BadFile(
            f"{checkpoint.folder} does not fit its own recipe ({str(error).splitlines()[0]})."
        ) from None
    policy.eval().requires_grad_(False)
    policy.checkpoint = checkpoint
    policy.pace = recipe.pace
    policy.denoise = recipe.denoise
    return policy


def load_encoder_of(checkpoint: Checkpoint, weights: WeightsSource = ANYWHERE) -> "Encoder | None":
    """Load the encoder a policy was trained on, verified; None for a policy without images.

    Raises:
        InputError: this is not the encoder it was trained on; otherwise as `load_encoder`.
    """
    record = checkpoint.encoder
    encoder = load_encoder(record.name, record.pool, weights) if record else None
    check_encoder(checkpoint, encoder)
    return encoder
