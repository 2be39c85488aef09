r"""Settings of `surgicai_checkpoint`: a policy of `surgicai-vision train` in `lerobot-eval`.

lerobot-eval --policy.type=surgicai_checkpoint --policy.checkpoint=released:handoff \
        --env.type=surgicai --env.checkpoint=released:handoff --eval.n_episodes=20
"""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode
from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim import AdamConfig

from surgicai_vision.core.errors import InputError


@PreTrainedConfig.register_subclass("surgicai_checkpoint")
@dataclass
class SurgicaiCheckpointConfig(PreTrainedConfig):  # type: ignore[misc]  # mypy skips LeRobot
    """Settings of `surgicai_checkpoint`.

    Attributes:
        checkpoint: folder of a checkpoint of `surgicai-vision train`, or released:NAME.
        encoder_weights: file with the pretrained weights of its encoder, if the encoder needs one
            that is not found automatically.
        push_to_hub: push the policy to the hub; off by default, unlike in LeRobot's own policies.
    """

    checkpoint: str = ""
    encoder_weights: str | None = None
    push_to_hub: bool = False
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            # The checkpoint itself holds the statistics of its inputs.
            "VISUAL": NormalizationMode.IDENTITY,
            "ENV": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    def validate_features(self) -> None:
        """Refuse a policy without a checkpoint."""
        if not self.checkpoint:
            raise InputError(
                "surgicai_checkpoint needs --policy.checkpoint=DIR, a checkpoint of "
                "surgicai-vision train, or released:NAME."
            )

    @property
    def observation_delta_indices(self) -> None:
        """Return None: the policy itself keeps past observations."""

    @property
    def action_delta_indices(self) -> None:
        """Return None: the policy predicts one action."""

    @property
    def reward_delta_indices(self) -> None:
        """Return None: the policy uses no rewards."""

    def get_optimizer_preset(self) -> AdamConfig:
        """Return LeRobot's default, which is never used."""
        return AdamConfig()

    def get_scheduler_preset(self) -> None:
        """Return None: the policy is not trained here."""
