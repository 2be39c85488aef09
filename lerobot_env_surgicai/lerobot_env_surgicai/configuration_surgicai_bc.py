"""Settings of `surgicai_bc`: behaviour cloning on frozen features, as a LeRobot policy."""

from dataclasses import dataclass, field, replace

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot.utils.constants import OBS_STATE

from policies.base import Recipe
from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names, check_camera
from surgicai_vision.core.errors import InputError
from surgicai_vision.features import encoders
from surgicai_vision.training import policies


@PreTrainedConfig.register_subclass("surgicai_bc")
@dataclass
class SurgicaiBcConfig(PreTrainedConfig):  # type: ignore[misc]  # mypy skips LeRobot
    """Settings of `surgicai_bc`; the defaults are the recipe "paper" (configs/recipes/paper.yaml).

    Attributes:
        encoder: frozen encoder of the images; null uses no images.
        encoder_weights: file with the encoder's pretrained weights, if it needs one that is not
            found automatically.
        encoder_pool: "global", "spatial" or "tokens".
        encoder_sha256: hash of the encoder's weights; written in training, verified afterwards.
        encoder_identity: hash of weights, preprocessing and pool; written in training, verified
            afterwards.
        views: cameras; empty takes all that the dataset has.
        hidden: width of each hidden layer.
        batch_norm: put BatchNorm before each hidden layer.
        proprioception: also use the tip's pose and the jaw as inputs.
        learning_rate: learning rate of Adam.
        push_to_hub: push the trained policy to the hub; off by default, unlike in LeRobot's own
            policies.
    """

    encoder: str | None = "imagenet-lite"
    encoder_weights: str | None = None
    encoder_pool: str = "global"
    encoder_sha256: str = ""
    encoder_identity: str = ""
    views: list[str] = field(default_factory=list)
    hidden: list[int] = field(default_factory=lambda: [256, 256, 256])
    batch_norm: bool = True
    proprioception: bool = True
    learning_rate: float = 1e-3
    push_to_hub: bool = False
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            # The encoder normalises images, BatchNorm the features; actions are within [-1, 1]
            # already.
            "VISUAL": NormalizationMode.IDENTITY,
            "ENV": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.encoder:
            encoders.check_encoder_name(self.encoder)
        for view in self.views:
            check_camera(view)
        self.recipe()

    def recipe(self) -> Recipe:
        """Return the same settings as a recipe of `bc`."""
        recipe: Recipe = replace(
            policies.load_recipe("bc", "paper"),
            hidden=tuple(self.hidden),
            batch_norm=self.batch_norm,
            proprioception=self.proprioception,
            learning_rate=self.learning_rate,
        )
        return recipe

    def validate_features(self) -> None:
        """Keep the inputs this policy takes and drop the rest (depth, segmentation, other views).

        Raises:
            InputError: the dataset or env lacks one of these inputs, or its actions are not ours.
        """
        # mypy skips its base
        given: dict[str, PolicyFeature] = self.input_features or {}  # type: ignore[has-type]
        kept = {key: given[key] for key in self._wanted(given) if key in given}
        missing = [key for key in self._wanted(given) if key not in given]
        if missing or not kept:
            raise InputError(
                f"surgicai_bc needs {', '.join(missing) or 'a view'}; given: {', '.join(given)}."
            )
        action = self.action_feature
        if action is None or tuple(action.shape) != (len(names.ACTION_NAMES),):
            raise InputError(
                f"surgicai_bc needs actions of {len(names.ACTION_NAMES)} values; given: {action}."
            )
        self.input_features = kept

    def _wanted(self, given: dict[str, PolicyFeature]) -> list[str]:
        """Return the keys of the inputs, images first."""
        state = [OBS_STATE] if self.proprioception else []
        if not self.encoder:
            return state
        if not self.views:
            visual = [key for key, feature in given.items() if feature.type is FeatureType.VISUAL]
            self.views = [view for view in camera_names() if names.image_key(view) in visual]
            if not self.views:
                raise InputError(
                    f"surgicai_bc found none of the views {', '.join(camera_names())} "
                    f"in {', '.join(given)}."
                )
        return [*map(names.image_key, self.views), *state]

    @property
    def observation_delta_indices(self) -> None:
        """Return None: the policy uses only the present observation."""

    @property
    def action_delta_indices(self) -> None:
        """Return None: the policy predicts one action."""

    @property
    def reward_delta_indices(self) -> None:
        """Return None: the policy uses no rewards."""

    def get_optimizer_preset(self) -> AdamConfig:
        """Return the paper's Adam, without clipping."""
        return AdamConfig(lr=self.learning_rate, grad_clip_norm=0.0)

    def get_scheduler_preset(self) -> None:
        """Return None: the learning rate is constant."""
