"""`surgicai_bc`: behaviour cloning on frozen features, as a LeRobot policy.

The network is the `bc` of surgicai-vision. The encoder is not part of the module: it is never
saved, trained or put into training mode; its name and hashes are in config.json and are verified
whenever the policy is loaded.
"""

import copy
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray
from safetensors import SafetensorError
from torch import Tensor, nn

from encoders.base import Encoder
from lerobot_env_surgicai.configuration_surgicai_bc import SurgicaiBcConfig
from lerobot_env_surgicai.images import (
    FeatureMemory,
    FrameEncoder,
    check_identity,
    encode,
    identity,
    load_encoder,
)
from policies.base import Policy
from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.training import policies


class SurgicaiBcPolicy(PreTrainedPolicy):  # type: ignore[misc]  # mypy skips LeRobot
    """Behaviour cloning: frozen features and the tip's pose in, one action out.

    Attributes:
        memoryless: True: an action depends only on the present observation, so episodes may share
            a batch.
    """

    config_class = SurgicaiBcConfig
    name = "surgicai_bc"
    memoryless = True

    def __init__(self, config: SurgicaiBcConfig, **_: object):
        super().__init__(config)
        config.validate_features()
        self._encoder: Encoder | None = None
        self._training_encoder: FeatureMemory | None = None
        visual: tuple[tuple[int, ...], ...] = ()
        if config.encoder:
            self._encoder = load_encoder(
                config.encoder, config.encoder_weights, config.encoder_pool
            )
            check_identity(
                self._encoder, config.encoder_sha256, config.encoder_identity, "surgicai_bc"
            )
            config.encoder_sha256 = self._encoder.weights_sha256
            config.encoder_identity = identity(self._encoder)
            self._training_encoder = FeatureMemory(self._encoder)
            visual = (self._encoder.shape,) * len(config.views)
        self.network = policies.policy_plugin("bc").make(config.recipe(), visual)
        self._acting: Policy | None = None

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, strict: bool = True, **arguments: object
    ) -> "SurgicaiBcPolicy":
        """Load a policy; unlike in LeRobot's own, a missing or unexpected tensor is an error.

        Raises:
            BadFile: the weights are damaged or belong to another network.
            InputError: the encoder is not the one that the policy was trained on.
        """
        try:
            policy: SurgicaiBcPolicy = super().from_pretrained(
                pretrained_name_or_path, strict=strict, **arguments
            )
        except (RuntimeError, SafetensorError) as error:
            reason = " ".join(str(error).split())[:200]
            raise BadFile(
                f"{pretrained_name_or_path} has no complete weights for surgicai_bc ({reason})."
            ) from None
        return policy

    def get_optim_params(self) -> Iterator[nn.Parameter]:
        """Return the trained parameters, which are the network's."""
        return self.network.parameters()

    def reset(self) -> None:
        """Do nothing: the policy has no memory."""

    def train(self, mode: bool = True) -> "SurgicaiBcPolicy":
        """Switch to training or evaluation mode; the encoder is not affected."""
        self._acting = None
        super().train(mode)
        return self

    def load_state_dict(self, *arguments: object, **options: object) -> object:
        """Load weights."""
        self._acting = None
        return super().load_state_dict(*arguments, **options)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the mean squared error of the actions, and the same as a number."""
        parts = [batch[OBS_STATE]] if self.config.proprioception else []
        features = self._features(batch, self._training_encoder)
        if features is not None:
            parts.insert(0, torch.from_numpy(features).to(batch[ACTION].device))
        observed = torch.cat(parts, dim=1)
        # An epoch may end with a batch of one, which has no variance for BatchNorm.
        training = self.network.training
        self.network.train(training and len(observed) > 1)
        loss = self.network.loss(observed, batch[ACTION])
        self.network.train(training)
        return loss, {"mse": loss.item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Return a chunk of one action, (B, 1, 7)."""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Return the actions (B, 7); a row's action does not depend on the rest of the batch."""
        acting = self._acting
        if acting is None:
            # `act` computes in float64 on the CPU, so it needs a copy of the weights that is not
            # moved or trained.
            acting = copy.deepcopy(self.network).cpu().eval()
            object.__setattr__(self, "_acting", acting)  # not a submodule: it must not be saved
        poses = batch[OBS_STATE].float().cpu().numpy()
        return torch.from_numpy(acting.act(self._features(batch, self._encoder), poses)).to(
            batch[OBS_STATE].device
        )

    def _features(
        self, batch: dict[str, Tensor], encoder: FrameEncoder | None
    ) -> NDArray[np.float32] | None:
        """Return the views' concatenated features (B, F) float32; None without images."""
        if encoder is None:
            return None
        for view in self.config.views:
            trained = self.config.input_features[names.image_key(view)].shape
            given = batch[names.image_key(view)]
            if tuple(given.shape[1:]) != tuple(trained):
                raise InputError(
                    f"surgicai_bc was trained on images of {tuple(trained)}, "
                    f"got {tuple(given.shape[1:])}; give --env.image_size={trained[-1]}."
                )
        return encode(encoder, batch, self.config.views)
