"""`surgicai`: the tasks of surgicai-vision as a LeRobot env.

    lerobot-eval --env.type=surgicai --env.dataset=outputs/datasets/grasp --policy.path=…

What a policy sees: `observation.images.<view>` and `observation.state` as in our datasets, never depth (ACT and
Diffusion take three channels only). With `encoder` it sees `observation.environment_state`, the frozen features
of the views, in place of the pictures.
"""

import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import FreezeAfterEpisodeEnd
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

import surgicai_vision.envs  # noqa: F401  # registers the gymnasium ids
from lerobot_env_surgicai.encoding import EncodeViews
from surgicai_vision import names, registry
from surgicai_vision.config import SceneConfig, TaskConfig, to_mapping
from surgicai_vision.dataset import open_dataset
from surgicai_vision.errors import InputError, check_name

DEFAULT = TaskConfig()
AGENT_POS, FEATURES = "agent_pos", "environment_state"


@EnvConfig.register_subclass("surgicai")
@dataclass
class SurgicaiEnv(EnvConfig):
    """An env of surgicai-vision.

    Attributes:
        task: one of `names.TASKS`.
        dataset: a dataset of ours, in place of everything from `task` to `encoder` but `encoder_weights`.
        cameras: views.
        image_size: height and width of a picture [px].
        step: step-size preset.
        tolerance: "paper" or "released".
        reward: "sparse" or "dense".
        max_steps: episode limit [control steps].
        scene: the scene.
        encoder: show this encoder's features of the views in place of pictures; None shows pictures.
        encoder_weights: file with the encoder's pretrained weights.
        encoder_sha256: hash of the weights it must have; empty for any.
    """

    task: str | None = DEFAULT.task
    fps: int = names.FPS
    dataset: str | None = None
    cameras: list[str] = field(default_factory=lambda: ["front", "back"])
    image_size: int = 224
    step: str = DEFAULT.step
    tolerance: str = DEFAULT.tolerance
    reward: str = DEFAULT.reward
    max_steps: int = DEFAULT.max_steps
    scene: SceneConfig = field(default_factory=SceneConfig)
    encoder: str | None = None
    encoder_weights: str | None = None
    encoder_sha256: str = ""

    def __post_init__(self) -> None:
        if self.dataset:
            self._follow(Path(self.dataset))
        self.dataset = None  # what it said stands in the fields, and a saved configuration stays whole without it
        for camera in self.cameras:
            check_name("camera", camera, names.CAMERAS)
        self.task_config()
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (len(names.ACTION_NAMES),))}
        self.features[AGENT_POS] = PolicyFeature(FeatureType.STATE, (len(names.STATE_NAMES),))
        if self.encoder:
            dim = len(self.cameras) * registry.encoder_card(self.encoder).dim
            self.features[FEATURES] = PolicyFeature(FeatureType.ENV, (dim,))
        else:
            shape = (self.image_size, self.image_size, 3)
            self.features |= {names.image_key(view): PolicyFeature(FeatureType.VISUAL, shape) for view in self.cameras}
        renamed = {AGENT_POS: OBS_STATE, FEATURES: OBS_ENV_STATE}
        self.features_map = {key: renamed.get(key, key) for key in self.features}

    def _follow(self, folder: Path) -> None:
        """Take task, scene, views, size and encoder from a dataset."""
        dataset = open_dataset(folder)
        config = dataset.config
        self.task, self.step, self.tolerance, self.reward = config.task, config.step, config.tolerance, config.reward
        self.max_steps, self.scene = config.max_steps, config.scene
        self.cameras, self.image_size = list(dataset.views), dataset.image_size
        features = dataset.meta.get("features")
        if features:
            self.cameras, self.encoder = list(features["views"]), features["encoder"]
            self.encoder_sha256 = features["weights_sha256"]

    def task_config(self) -> TaskConfig:
        """Return the task and its scene; refuses what does not exist."""
        if self.task is None:
            raise InputError(f"--env.task is missing; give one of {', '.join(names.TASKS)}, or --env.dataset.")
        return TaskConfig(self.task, self.scene, self.step, self.tolerance, self.reward, self.max_steps)

    @property
    def gym_id(self) -> str:
        """Return the gymnasium id of the task."""
        return names.ENV_IDS[self.task_config().task]

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Return the arguments of `gymnasium.make`; its step limit gives LeRobot `_max_episode_steps`."""
        return {
            "obs_type": "pixels_agent_pos",
            "cameras": tuple(self.cameras),
            "image_size": self.image_size,
            "step": self.step,
            "tolerance": self.tolerance,
            "reward": self.reward,
            "max_steps": self.max_steps,
            "scene": to_mapping(self.scene),
            "render_mode": "rgb_array",
            "max_episode_steps": self.max_steps,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Return `n_envs` envs side by side, in processes of their own when asked for.

        A finished env waits for the others (`FreezeAfterEpisodeEnd`): its next episode would leak a step of
        reward into this one's, and cost its rendering.
        """
        make = functools.partial(make_one, self.gym_id, self.disable_env_checker, self.gym_kwargs)
        if use_async_envs and n_envs > 1:
            # LeRobot's choice: a fork would copy the GL context and torch's threads.
            vector: VectorEnv = AsyncVectorEnv(
                [make] * n_envs, context="forkserver", autoreset_mode=AutoresetMode.SAME_STEP
            )
        else:
            vector = SyncVectorEnv([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)
        return {self.type: {0: vector}}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return what stands between env and policy: the encoder, when there is one."""
        steps = []
        if self.encoder:
            steps = [EncodeViews(self.encoder, tuple(self.cameras), self.encoder_weights, self.encoder_sha256)]
        return PolicyProcessorPipeline(steps=steps), PolicyProcessorPipeline(steps=[])


def make_one(gym_id: str, disable_env_checker: bool, arguments: dict[str, Any]) -> gymnasium.Env:
    """Make one env; a function of this module, so that a worker process that unpickles it registers the ids."""
    return FreezeAfterEpisodeEnd(gymnasium.make(gym_id, disable_env_checker=disable_env_checker, **arguments))
