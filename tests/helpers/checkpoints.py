"""Untrained checkpoints on disk, for the tests of what reads them."""

from pathlib import Path

from policies.bc import BC
from policies.hlp import HLP
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.training.checkpoint import Checkpoint, write_checkpoint
from surgicai_vision.training.run_config import RunConfig


def checkpoint(folder: Path, task: str, policy: str = "bc", env: TaskConfig | None = None) -> str:
    """Write an untrained policy that sees no image, by default of the plain env of its task."""
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
    write_checkpoint(folder, written, plugin.make(plugin.recipe(), ()).state_dict())
    return str(folder)
