"""LeRobot's ACT, Diffusion and VQ-BeT, trained by `surgicai-vision train` on cached features.

    surgicai-vision train --task handoff --policy act --encoder imagenet-lite-early --pool spatial

The networks and their losses are LeRobot's own classes, unmodified: `ACTPolicy`, `DiffusionPolicy`,
`VQBeTPolicy`. Only the image backbone differs: a frozen encoder whose features come from the cache,
followed by the trained head of `bc` if the features are maps (`policies.layers`). The output is
`observation.environment_state`; VQ-BeT, which takes only images, gets it instead of its image
encoder's features. `settings` of a recipe are fields of LeRobot's configuration.

Other differences from `lerobot-train`: inputs are normalised to mean 0 and variance 1 for all three
(LeRobot scales the state of Diffusion and VQ-BeT to [-1, 1]); padded actions are excluded from
Diffusion's loss (`do_mask_loss_for_padding`). Actions are normalised as in LeRobot.
"""

import abc
import contextlib
import io
from typing import Any, final

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import nn

from policies.base import ACTIONS, Recipe
from policies.chunks import ChunkPolicy, ChunkRecipe
from policies.lerobot import horizon
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name

type Batch = dict[str, torch.Tensor]
IS_PAD = "action_is_pad"
VQ_BATCH = 256
"""Chunks per update of VQ-BeT's action codes (LeRobot uses the batch size of the training)."""


class LeRobotChunks(ChunkPolicy, abc.ABC):
    """Base of the three policies: it builds LeRobot's batches."""

    normalisation = "min_max"

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        assert isinstance(recipe, ChunkRecipe)
        super().__init__(recipe, visual, self.normalisation)
        self.vector_dim = self.inputs.width
        self.seen_dim = self.heads.dim or self.vector_dim
        self.network = self.build(recipe)

    @abc.abstractmethod
    def build(self, recipe: ChunkRecipe) -> PreTrainedPolicy:
        """Return LeRobot's policy for this recipe."""

    @abc.abstractmethod
    def _batch(self, visual: torch.Tensor, vector: torch.Tensor) -> Batch:
        """Return the batch that LeRobot's policy sees; arguments as in `plan_normalised`."""

    def chunk_loss(
        self,
        visual: torch.Tensor,
        vector: torch.Tensor,
        actions: torch.Tensor,
        is_pad: torch.Tensor,
    ) -> torch.Tensor:
        """Return LeRobot's own loss of a batch (scalar)."""
        batch = {**self._batch(visual, vector), ACTION: actions, IS_PAD: is_pad}
        loss: torch.Tensor = self.network(batch)[0]
        return loss

    def state_features(self) -> dict[str, PolicyFeature]:
        """Return the inputs in LeRobot's form: the state, and features as environment state."""
        return {
            OBS_STATE: PolicyFeature(FeatureType.STATE, (self.vector_dim,)),
            OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (self.seen_dim,)),
        }

    def shown(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return the images' features, (B, h, seen_dim), or the vector if there are no images."""
        return visual if self.heads.dim else vector


@final
class Act(LeRobotChunks):
    """LeRobot's Action Chunking Transformer.

    Its loss is L1 plus, in training, the weighted KL divergence of the latent.
    """

    normalisation = "mean_std"

    def build(self, recipe: ChunkRecipe) -> PreTrainedPolicy:
        """Return `ACTPolicy`."""
        if recipe.history != 1:
            raise InputError(
                f"history is {recipe.history}; ACT sees only the present observation; use 1."
            )
        if recipe.samples != 1:
            raise InputError(f"samples is {recipe.samples}; ACT does not sample; use 1.")
        config = _config(
            ACTConfig,
            recipe,
            input_features=self.state_features(),
            chunk_size=recipe.chunk,
            n_action_steps=recipe.execute,
            pretrained_backbone_weights=None,
        )
        return ACTPolicy(config)

    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return the chunk decoded from the mean of the latent."""
        self.network.eval()
        chunk: torch.Tensor = self.network.predict_action_chunk(self._batch(visual, vector))
        return chunk

    def _batch(self, visual: torch.Tensor, vector: torch.Tensor) -> Batch:
        return {OBS_STATE: vector[:, -1], OBS_ENV_STATE: self.shown(visual, vector)[:, -1]}


@final
class Diffusion(LeRobotChunks):
    """LeRobot's Diffusion Policy with its convolutional U-Net.

    Its loss is the squared error of the noise.
    """

    def build(self, recipe: ChunkRecipe) -> PreTrainedPolicy:
        """Return `DiffusionPolicy`."""
        config = _config(
            DiffusionConfig,
            recipe,
            input_features=self.state_features(),
            n_obs_steps=recipe.history,
            horizon=horizon(recipe),
            n_action_steps=recipe.chunk,
            pretrained_backbone_weights=None,
            do_mask_loss_for_padding=True,
        )
        return DiffusionPolicy(config)

    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return a chunk denoised from random noise."""
        chunk: torch.Tensor = self.network.diffusion.generate_actions(self._batch(visual, vector))
        return chunk

    def _batch(self, visual: torch.Tensor, vector: torch.Tensor) -> Batch:
        return {OBS_STATE: vector, OBS_ENV_STATE: self.shown(visual, vector)}


class _Given(nn.Module):
    """Replaces VQ-BeT's image encoder: the features are already computed."""

    def __init__(self, dim: int):
        super().__init__()
        self.feature_dim = dim

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return (B, dim) as given."""
        return rows


@final
class VqBet(LeRobotChunks):
    """LeRobot's VQ-BeT: action codes first, then a transformer that predicts them."""

    def build(self, recipe: ChunkRecipe) -> PreTrainedPolicy:
        """Return `VQBeTPolicy` without its image encoder."""
        if recipe.history > 1 and recipe.frame_stride > 1:
            raise InputError(
                f"history is {recipe.history} with frame_stride {recipe.frame_stride}; VQ-BeT "
                "predicts the actions of every moment it sees: take history=1 or frame_stride=1."
            )
        dim = self.seen_dim + self.seen_dim % 2  # LeRobot needs twice a number of key points
        side = 64  # of a nominal image: LeRobot builds an encoder for it, unused
        config = _config(
            VQBeTConfig,
            recipe,
            input_features={
                OBS_STATE: PolicyFeature(FeatureType.STATE, (self.vector_dim,)),
                names.image_key("front"): PolicyFeature(FeatureType.VISUAL, (3, side, side)),
            },
            n_obs_steps=recipe.history,
            action_chunk_size=recipe.chunk,
            pretrained_backbone_weights=None,
            crop_shape=None,
            spatial_softmax_num_keypoints=dim // 2,
        )
        policy = VQBeTPolicy(config)
        policy.vqbet.rgb_encoder = _Given(dim)
        self._padding = dim - self.seen_dim
        return policy

    def measure(self, target: torch.Tensor) -> None:
        """Store the actions' statistics, then fit the action codes as LeRobot's first phase does.

        LeRobot fits them in the first `n_vqvae_training_steps` updates of the training, with the
        learning rate and the weight decay of its configuration; here this is done before training.
        """
        super().measure(target)
        head = self.network.vqbet.action_head
        config = self.network.config
        codes = head.vqvae_model
        optimiser = torch.optim.Adam(
            [weights for weights in codes.parameters() if weights.requires_grad],
            lr=config.optimizer_vqvae_lr,
            weight_decay=config.optimizer_vqvae_weight_decay,
        )
        actions = (target[..., :ACTIONS] - self.action_centre) / self.action_scale
        codes.train()
        for _ in range(config.n_vqvae_training_steps):
            rows = torch.randint(len(actions), (min(VQ_BATCH, len(actions)),))
            with contextlib.redirect_stdout(io.StringIO()):  # it prints when it is done
                loss = head.discretize(config.n_vqvae_training_steps, actions[rows])[0]
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
        codes.requires_grad_(False)

    def chunk_loss(
        self,
        visual: torch.Tensor,
        vector: torch.Tensor,
        actions: torch.Tensor,
        is_pad: torch.Tensor,
    ) -> torch.Tensor:
        """Return LeRobot's loss of the second phase, over the codes and the offsets."""
        batch = {**self._batch(visual, vector), ACTION: actions}
        _, losses = self.network.vqbet(batch, rollout=False)
        loss: torch.Tensor = losses["loss"]
        return loss

    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return the chunk of codes sampled from their predicted probabilities."""
        chunk: torch.Tensor = self.network.vqbet(self._batch(visual, vector), rollout=True)
        return chunk

    def _batch(self, visual: torch.Tensor, vector: torch.Tensor) -> Batch:
        shown = self.shown(visual, vector)
        padded = nn.functional.pad(shown, (0, self._padding))
        return {OBS_STATE: vector, OBS_IMAGES: padded[:, :, None]}  # one image per moment


def _config[Config: PreTrainedConfig](
    kind: type[Config], recipe: ChunkRecipe, **ours: Any
) -> Config:
    """Return LeRobot's configuration with a recipe's settings.

    Raises:
        UnknownName: a setting is not in LeRobot's configuration.
        InputError: a setting follows from the recipe, or LeRobot refuses it.
    """
    for name, value in recipe.settings.items():
        if name in ours:
            raise InputError(
                f"settings: {name} follows from the recipe; remove it (given: {value})."
            )
        check_name("setting", name, kind.__dataclass_fields__)
    lists = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in recipe.settings.items()
    }
    action = {ACTION: PolicyFeature(FeatureType.ACTION, (ACTIONS,))}
    try:
        config: Config = kind(**{**lists, **ours, "output_features": action, "device": "cpu"})
    except (TypeError, ValueError, NotImplementedError) as error:
        raise InputError(f"LeRobot refuses the settings: {error}.") from None
    return config
