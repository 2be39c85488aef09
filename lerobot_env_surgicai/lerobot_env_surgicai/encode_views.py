"""EncodeViews: the step between env and policy that turns images into frozen features."""

from dataclasses import dataclass

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_env_surgicai.images import check_identity, encode, load_encoder
from surgicai_vision.core import names


@ProcessorStepRegistry.register("surgicai_encode_views")
@dataclass
class EncodeViews(ObservationProcessorStep):  # type: ignore[misc]  # mypy skips LeRobot
    """Replace the views' images with their features.

    The features are `observation.environment_state`, (B, views × dim).

    Attributes:
        encoder: the encoder's name.
        views: cameras, in the order of the features.
        weights: file with the encoder's pretrained weights.
        sha256: hash that the weights must have; empty for any.
    """

    encoder: str
    views: tuple[str, ...]
    weights: str | None = None
    sha256: str = ""

    def observation(self, observation: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the observation with features instead of images."""
        encoder = load_encoder(self.encoder, self.weights, "global")
        check_identity(encoder, self.sha256, "", "The policy")
        features = torch.from_numpy(encode(encoder, observation, self.views))
        images = {names.image_key(view) for view in self.views}
        return {
            **{key: value for key, value in observation.items() if key not in images},
            OBS_ENV_STATE: features,
        }

    def get_config(self) -> dict[str, object]:
        """Return the arguments of this step."""
        return {
            "encoder": self.encoder,
            "views": self.views,
            "weights": self.weights,
            "sha256": self.sha256,
        }

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Return the feature table unchanged: the env's table already lists this step's output."""
        return features
