"""`surgicai_checkpoint`: LeRobot's standard pre- and post-processing, without normalisation."""

import torch
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_env_surgicai.configuration_surgicai_checkpoint import SurgicaiCheckpointConfig


def make_surgicai_checkpoint_pre_post_processors(
    config: SurgicaiCheckpointConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return the pipelines around the policy."""
    before: PolicyProcessorPipeline
    after: PolicyProcessorPipeline
    before, after = make_default_pre_post_processors(config, dataset_stats or {})
    return before, after
