"""Features extractors of Stable-Baselines3: relative features of goal dicts, and standardising.

    SAC("MultiInputPolicy", env, policy_kwargs={
        "features_extractor_class": RelativeExtractor,
        "features_extractor_kwargs": {"task": "grasp"},
    }, replay_buffer_class=HerReplayBuffer)

The features are computed from the dict that the replay buffer hands out, so after relabelling. They
hold no weights: `mean` and `std` are buffers of the module and are saved with a model.
"""

from collections.abc import Sequence
from typing import cast, final

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from surgicai_vision.core import names
from surgicai_vision.core.errors import check_name
from surgicai_vision.envs.relative import relative_features
from surgicai_vision.scene.kinematics import base_in_world

RELATIVE = len(names.RELATIVE_NAMES)


class StandardExtractor(BaseFeaturesExtractor):
    """An observation that is one array, standardised.

    Args:
        observation_space: a Box (n,).
        mean: what is removed from each element, (n,); None removes nothing.
        std: what each is then divided by, (n,); None divides by 1.
    """

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[object],
        mean: Sequence[float] | None = None,
        std: Sequence[float] | None = None,
    ):
        size = RELATIVE
        if not isinstance(observation_space, spaces.Dict):
            assert observation_space.shape is not None
            size = observation_space.shape[0]
        super().__init__(cast(spaces.Box, observation_space), size)
        self.register_buffer("mean", torch.tensor(np.zeros(size) if mean is None else mean).float())
        self.register_buffer("std", torch.tensor(np.ones(size) if std is None else std).float())

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the standardised observations (B, n)."""
        return (observations - self.mean) / self.std


@final
class RelativeExtractor(StandardExtractor):
    """The relative features of a goal dict, standardised; see the module's docstring.

    Args:
        observation_space: that of obs_type "goal".
        task: a subtask, whose arm acts.
        mean: as for `StandardExtractor`, (24,).
        std: the same.
    """

    def __init__(
        self,
        observation_space: spaces.Space[object],
        task: str,
        mean: Sequence[float] | None = None,
        std: Sequence[float] | None = None,
    ):
        super().__init__(observation_space, mean, std)
        arm = names.ACTIVE_ARM[check_name("subtask", task, names.SUBTASKS)]
        self._base = np.asarray(base_in_world(arm))[:3, :3]

    def forward(self, observations: torch.Tensor | dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the standardised features (B, 24) of goal dicts."""
        assert isinstance(observations, dict), "the relative features are those of a goal dict"
        parts = ("observation", "achieved_goal", "desired_goal")
        seen, achieved, desired = (observations[part].detach().cpu().numpy() for part in parts)
        features = torch.from_numpy(relative_features(seen, achieved, desired, self._base))
        return super().forward(features.to(self.mean.device))
