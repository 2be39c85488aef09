"""`surgicai_bc`: LeRobot's standard pre- and post-processing, safe for inputs that never vary."""

import torch
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors
from lerobot.utils.constants import OBS_STATE

from lerobot_env_surgicai.configuration_surgicai_bc import SurgicaiBcConfig

SMALLEST_STD = 1e-6  # a component that varies less is constant, and only its mean is removed


def make_surgicai_bc_pre_post_processors(
    config: SurgicaiBcConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return the pipelines around the policy.

    The state is normalised to mean 0 and std 1; images and actions are not changed.
    """
    statistics = dict(dataset_stats or {})
    if "std" in statistics.get(OBS_STATE, {}):
        std = torch.as_tensor(statistics[OBS_STATE]["std"])
        std = torch.where(std < SMALLEST_STD, torch.ones_like(std), std)
        statistics[OBS_STATE] = {**statistics[OBS_STATE], "std": std}
    before: PolicyProcessorPipeline
    after: PolicyProcessorPipeline
    before, after = make_default_pre_post_processors(config, statistics)
    return before, after
