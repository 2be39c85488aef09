"""Features extractors of Stable-Baselines3: relative features of goal dicts, and standardisation.

    SAC("MultiInputPolicy", env, policy_kwargs={
        "features_extractor_class": RelativeExtractor,
        "features_extractor_kwargs": {"task": "grasp"},
    }, replay_buffer_class=HerReplayBuffer)

The features are computed from the dict that the replay buffer returns, so after relabelling. The
extractors have no weights: `mean` and `std` are buffers of the module and are saved with a model.

The library gives actor, critics and their targets one extractor each, and all get the same tensors
of a batch in turn. With one `FeatureMemo` shared by all, the features are computed only once.
"""

from collections import deque
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
PARTS = ("observation", "achieved_goal", "desired_goal")
"""Parts of a goal dict."""


@final
class FeatureMemo:
    """The features of the last goal dicts, identified by their tensor objects.

    Tensors of a batch are never modified. The memo is not saved with a model.
    """

    KEPT = 2
    """Observations and next observations of a batch."""

    def __init__(self) -> None:
        self._kept: deque[tuple[tuple[torch.Tensor, ...], torch.Tensor]] = deque(maxlen=self.KEPT)

    def find(self, parts: tuple[torch.Tensor, ...]) -> torch.Tensor | None:
        """Return the features of these very tensors, or None."""
        for known, features in self._kept:
            if all(one is other for one, other in zip(known, parts, strict=True)):
                return features
        return None

    def keep(self, parts: tuple[torch.Tensor, ...], features: torch.Tensor) -> None:
        """Keep the features of these tensors, and forget the oldest."""
        self._kept.append((parts, features))

    def __reduce__(self) -> tuple[type["FeatureMemo"], tuple[()]]:
        """Return how to make an empty one."""
        return FeatureMemo, ()


class StandardExtractor(BaseFeaturesExtractor):
    """Standardise an observation that is one array.

    Args:
        observation_space: a Box (n,).
        mean: mean subtracted from each element, (n,); None subtracts nothing.
        std: standard deviation each is then divided by, (n,); None divides by 1.
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
    """Compute and standardise a goal dict's relative features; see the module's docstring.

    Args:
        observation_space: that of obs_type "goal".
        task: a subtask; its arm acts.
        mean: as for `StandardExtractor`, (24,).
        std: the same.
        memo: shared by all extractors of a model; None computes the features each time.
    """

    def __init__(
        self,
        observation_space: spaces.Space[object],
        task: str,
        mean: Sequence[float] | None = None,
        std: Sequence[float] | None = None,
        memo: FeatureMemo | None = None,
    ):
        super().__init__(observation_space, mean, std)
        self._memo = memo
        arm = names.ACTIVE_ARM[check_name("subtask", task, names.SUBTASKS)]
        self._base = np.asarray(base_in_world(arm))[:3, :3]

    def forward(self, observations: torch.Tensor | dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the standardised features (B, 24) of goal dicts."""
        assert isinstance(observations, dict), "the relative features need a goal dict"
        parts = tuple(observations[part] for part in PARTS)
        features = self._memo.find(parts) if self._memo else None
        if features is None:
            seen, achieved, desired = (part.detach().cpu().numpy() for part in parts)
            features = torch.from_numpy(relative_features(seen, achieved, desired, self._base))
            if self._memo:
                self._memo.keep(parts, features)
        return super().forward(features.to(self.mean.device))
