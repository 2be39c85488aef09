"""`surgicai_bc`: LeRobot's standard pre- and post-processing, safe for inputs that never vary."""

from typing import Any

import torch
from lerobot.processor import make_default_pre_post_processors
from lerobot.utils.constants import OBS_STATE

from lerobot_env_surgicai.configuration_surgicai_bc import SurgicaiBcConfig

SMALLEST_STD = 1e-6  # a component that varies less is constant, and only its mean is removed


def make_surgicai_bc_pre_post_processors(
    config: SurgicaiBcConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return the pipelines around the policy: state to mean 0 and std 1, images and actions as they
    are.
    """
    statistics = dict(dataset_stats or {})
    if "std" in statistics.get(OBS_STATE, {}):
        std = torch.as_tensor(statistics[OBS_STATE]["std"])
        std = torch.where(std < SMALLEST_STD, torch.ones_like(std), std)
        statistics[OBS_STATE] = {**statistics[OBS_STATE], "std": std}
    return make_default_pre_post_processors(config, statistics)
