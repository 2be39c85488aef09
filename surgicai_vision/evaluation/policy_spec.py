"""Subjects: who is evaluated in which task: a baseline, blind replay, the policy of a checkpoint
folder.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.agent import Agent, MakeAgent
from surgicai_vision.evaluation.agents import (
    BASELINES,
    PolicyAgent,
    ReplayAgent,
    mean_demonstration,
)
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource

if TYPE_CHECKING:
    from surgicai_vision.dataset.protocol import Dataset


@dataclass(frozen=True)
class Subject:
    """Who is evaluated in which task.

    Attributes:
        name: how tables call it.
        config: the task.
        make_agent: makes the agent in a worker process.
        about: more to be kept beside the result.
    """

    name: str
    config: TaskConfig
    make_agent: MakeAgent
    about: dict[str, Any] = field(default_factory=dict)


def policy_name(
    encoder: str | None,
    views: Sequence[str],
    pool: str = "global",
    privileged: bool = False,
    policy: str = "bc",
    recipe: str = "paper",
) -> str:
    """Name a policy by its inputs, and by what is not as usual."""
    name = (
        f"{encoder}-{'+'.join(views)}" if encoder else "state" if privileged else "proprioception"
    )
    unusual = [part for part, usual in ((pool, "global"), (recipe, "paper")) if part != usual]
    return "-".join([*([] if policy == "bc" else [policy]), name.replace(":", "-"), *unusual])


def baseline_subject(name: str, config: TaskConfig) -> Subject:
    """Return the subject of a baseline: expert, random or zero."""
    return Subject(name, config, functools.partial(baseline, name))


def replay_subject(dataset: "Dataset") -> Subject:
    """Return the subject that replays the mean demonstration of an opened dataset, blind.

    Raises:
        InputError: a dataset without every step's frame.
    """
    if dataset.fps != names.FPS:
        raise InputError(
            f"{dataset.path} holds {dataset.fps} frames a second; a replay needs each step's: {names.FPS}."
        )
    actions = mean_demonstration(dataset.columns()[names.ACTION], dataset.episode_index)
    about = {"dataset": dataset.fingerprint}
    return Subject(ReplayAgent.name, dataset.config, functools.partial(ReplayAgent, actions), about)


def checkpoint_subject(folder: Path, weights: WeightsSource = ANYWHERE) -> Subject:
    """Return the subject of a checkpoint folder; its weights are looked up at once.

    Raises:
        BadFile: no checkpoint folder.
        MissingWeights: the encoder's weights are not at hand.
    """
    from surgicai_vision.features import encoders
    from surgicai_vision.training import policies
    from surgicai_vision.training.checkpoint import read_checkpoint

    checkpoint = read_checkpoint(folder)
    if policies.policy_plugin(checkpoint.policy).target != names.ACTION:
        raise InputError(
            f"{folder} chooses subtasks and does not act; name it as hlp: in the file of a chain (docs/chain.md)."
        )
    encoder = checkpoint.encoder
    if encoder:
        encoders.find_weights(encoder.name, weights)
    about = {
        "checkpoint": {
            "weights_sha256": encoder.weights_sha256 if encoder else None,
            "policy_sha256": checkpoint.policy_sha256,
            "policy": checkpoint.policy,
            "recipe": checkpoint.recipe_name,
            "seed": checkpoint.seed,
            "dataset": checkpoint.dataset,
            "demonstrations": checkpoint.demonstrations,
        },
        "folder": str(folder),
        "views": list(checkpoint.views),
        "encoder": encoder.name if encoder else checkpoint_name(checkpoint),
    }
    make = functools.partial(policy_agent, folder, weights)
    return Subject(checkpoint_name(checkpoint), checkpoint.task, make, about)


def checkpoint_name(checkpoint: Any) -> str:
    """How tables call a checkpoint's policy."""
    encoder = checkpoint.encoder
    privileged = bool(checkpoint.recipe.get("privileged"))
    pool = encoder.pool if encoder else "global"
    name = encoder.name if encoder else None
    return policy_name(
        name, checkpoint.views, pool, privileged, checkpoint.policy, checkpoint.recipe_name
    )


def expert() -> Agent:
    """Make the expert (in a worker process)."""
    return baseline("expert")


def baseline(name: str) -> Agent:
    """Make a baseline agent (in a worker process)."""
    return BASELINES[name]()


def policy_agent(folder: Path, weights: WeightsSource = ANYWHERE) -> PolicyAgent:
    """Make the agent of a checkpoint folder (in a worker process).

    Raises:
        InputError: the encoder at hand is not the one the policy was trained on.
    """
    from surgicai_vision.training import policies

    policy = policies.load_policy(folder)
    checkpoint = policy.checkpoint
    encoder = policies.load_encoder_of(checkpoint, weights)
    name, vector = checkpoint_name(checkpoint), policy.inputs.vector or names.STATE
    return PolicyAgent(name, policy, encoder, checkpoint.views, checkpoint.image_size, vector)
