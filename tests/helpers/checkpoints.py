"""Untrained checkpoints on disk, for tests of code that reads them."""

from pathlib import Path

import torch

from policies.bc import BC
from policies.hlp import HLP
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.training.checkpoint import Checkpoint, write_checkpoint
from surgicai_vision.training.run_config import RunConfig


def checkpoint(folder: Path, task: str, policy: str = "bc", env: TaskConfig | None = None) -> str:
    """Write an untrained policy that sees no image, by default of the plain env of its task.

    Its weights are drawn from a fixed seed.
    """
    plugin = {"bc": BC, "hlp": HLP}[policy]
    written = Checkpoint(
        run=RunConfig(env or TaskConfig(task), policy=policy, demonstrations=1),
        recipe=to_mapping(plugin.recipe()),
        image_size=32,
        encoder=None,
        proprioception=True,
        epoch=1,
        dataset="",
        frames=1,
        validation_episodes=(),
        train_losses=(),
        validation_losses=(),
        device="cpu",
        code_version="",
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        untrained = plugin.make(plugin.recipe(), ())
    write_checkpoint(folder, written, untrained.state_dict())
    return str(folder)
