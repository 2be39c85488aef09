"""`surgicai`: the tasks of surgicai-vision as a LeRobot env.

    lerobot-eval --env.type=surgicai --env.dataset=outputs/datasets/grasp --policy.path=…

A policy sees `observation.images.<view>` and `observation.state` as in our datasets, never depth
(ACT and Diffusion take three channels only). With `encoder` it sees
`observation.environment_state`, the frozen features of the views, instead of the images.

All five tasks in one call, with results per task and overall:

    lerobot-eval --env.type=surgicai --env.tasks='[grasp,place,insert,handoff,pullout]' …
"""

import dataclasses
import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import FreezeAfterEpisodeEnd
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray

from lerobot_env_surgicai.encode_views import EncodeViews
from surgicai_vision.core import names
from surgicai_vision.core.cameras import check_camera
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig, to_mapping
from surgicai_vision.core.errors import check_name
from surgicai_vision.core.instructions import INSTRUCTION_BANKS, STANDARD, draw_instruction
from surgicai_vision.core.tasks import env_id, task_names
from surgicai_vision.dataset import open_dataset
from surgicai_vision.envs.base import most_actions
from surgicai_vision.features import encoders
from surgicai_vision.training import released
from surgicai_vision.training.checkpoint import read_checkpoint

AGENT_POS = "agent_pos"
FEATURES = "environment_state"
SUBTASKS = names.SUBTASKS
TASK_FIELDS = tuple(field.name for field in dataclasses.fields(TaskConfig))


@EnvConfig.register_subclass("surgicai")
@dataclass
class SurgicaiEnv(EnvConfig):  # type: ignore[misc]  # mypy skips LeRobot
    """An env of surgicai-vision.

    Values that are None are taken from `dataset` or `checkpoint`. Without these they are the
    defaults of `TaskConfig`, two views of 224 px, and images. The env then sets `dataset` and
    `checkpoint` to None, so that a saved configuration is complete by itself.

    Attributes:
        task: one of `tasks.task_names()`.
        dataset: a dataset of ours.
        checkpoint: a checkpoint of `surgicai-vision train`, or released:NAME, to take task, views
            and image size from, instead of `dataset`.
        cameras: views.
        image_size: height and width of an image [px].
        step: step-size preset.
        tolerance: "paper" or "released".
        reward: "sparse", "dense" or "staged".
        max_steps: episode limit [control steps].
        scene: the scene.
        randomisation: what differs from episode to episode besides the start.
        action_repeat: control steps that an action is held.
        hold_jaw: take the jaw's action as 0 in subtasks that start with the needle held.
        end_on_drop: end the episode if the needle drops in a subtask that starts with it held.
        advance: how the whole procedure moves to its next subtask: "success" or "told".
        encoder: show this encoder's features of the views instead of images.
        encoder_weights: file with the encoder's pretrained weights.
        encoder_sha256: hash that the weights must have; empty for any.
        tasks: several tasks instead of `task`, each a separate group in LeRobot's results. Each
            has its own step limit, whatever `max_steps` says; all else is the same.
        instructions: bank of the sentences that describe the task (`core.instructions`):
            "standard", or "train" or "heldout", from which every episode draws one.
    """

    task: str | None = None
    fps: int = names.FPS
    dataset: str | None = None
    checkpoint: str | None = None
    cameras: list[str] | None = None
    image_size: int | None = None
    step: str | None = None
    tolerance: str | None = None
    reward: str | None = None
    max_steps: int | None = None
    scene: SceneConfig | None = None
    randomisation: RandomisationConfig | None = None
    action_repeat: int | None = None
    hold_jaw: bool | None = None
    end_on_drop: bool | None = None
    advance: str | None = None
    encoder: str | None = None
    encoder_weights: str | None = None
    encoder_sha256: str = ""
    tasks: list[str] = field(default_factory=list)
    instructions: str = STANDARD

    def __post_init__(self) -> None:
        check_name("bank of instructions", self.instructions, INSTRUCTION_BANKS)
        for task in self.tasks:
            check_name("task", task, task_names())
        if self.tasks:
            self.task = self.task or self.tasks[0]
        config = TaskConfig(self.task) if self.task else TaskConfig()
        self._fill(config, ["front", "back"], 224)
        for camera in self.views:
            check_camera(camera)
        self.task_config()
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (len(names.ACTION_NAMES),))}
        self.features[AGENT_POS] = PolicyFeature(FeatureType.STATE, (len(names.STATE_NAMES),))
        if self.encoder:
            dim = len(self.views) * encoders.encoder_card(self.encoder).dim
            self.features[FEATURES] = PolicyFeature(FeatureType.ENV, (dim,))
        else:
            shape = (self.image_size, self.image_size, 3)
            self.features |= {
                names.image_key(view): PolicyFeature(FeatureType.VISUAL, shape)
                for view in self.views
            }
        renamed = {AGENT_POS: OBS_STATE, FEATURES: OBS_ENV_STATE}
        self.features_map = {key: renamed.get(key, key) for key in self.features}

    def _fill(self, config: TaskConfig, cameras: list[str], image_size: int) -> None:
        """Fill values that are None from the dataset or the checkpoint, else from the arguments."""
        features: dict[str, PolicyFeature] = {}
        if self.dataset:
            dataset = open_dataset(Path(self.dataset))
            config = dataset.config
            image_size = dataset.image_size
            features = dataset.meta.get("features") or {}
            cameras = list(features.get("views", dataset.views))
        if self.checkpoint:
            trained = read_checkpoint(released.resolve(self.checkpoint))
            config = trained.task
            image_size = trained.image_size
            cameras = list(dict.fromkeys(map(names.camera_of, trained.views))) or cameras
        if self.task and self.task != config.task:  # another task has its own limit
            config = dataclasses.replace(config, task=self.task, max_steps=0)
        for key in TASK_FIELDS:
            if getattr(self, key) is None:
                setattr(self, key, getattr(config, key))
        self.cameras = list(self.cameras or cameras)
        self.image_size = self.image_size or image_size
        if self.encoder is None and features:
            self.encoder = features["encoder"]
            self.encoder_sha256 = features["weights_sha256"]
        self.dataset = None
        self.checkpoint = None

    @property
    def views(self) -> tuple[str, ...]:
        """Return the views."""
        return tuple(self.cameras or ())

    def task_config(self) -> TaskConfig:
        """Return the task and its scene; refuse values that do not exist."""
        return TaskConfig(**{key: getattr(self, key) for key in TASK_FIELDS})

    @property
    def gym_id(self) -> str:
        """Return the gymnasium id of the task."""
        return env_id(self.task_config().task)

    @property
    def gym_kwargs(self) -> dict[str, object]:
        """Return the arguments of `gymnasium.make`.

        Its step limit gives LeRobot `_max_episode_steps`, which counts actions.
        """
        task = self.task_config()
        config = to_mapping(task)
        del config["task"], config["max_steps"]
        return {
            **config,
            "obs_type": "pixels_agent_pos",
            "cameras": self.views,
            "image_size": self.image_size,
            "render_mode": "rgb_array",
            "max_episode_steps": most_actions(task),
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, VectorEnv]]:
        """Return `n_envs` vectorised envs, in separate processes if requested.

        A finished env waits for the others (`FreezeAfterEpisodeEnd`): its next episode would leak a
        step of reward into the present one, and would have to be rendered.
        """
        if self.tasks:
            parts = {
                task: dataclasses.replace(
                    self, task=task, tasks=[], max_steps=TaskConfig(task).max_steps
                )
                for task in self.tasks
            }
            return {
                task: dict(enumerate(part.create_envs(n_envs, use_async_envs)[self.type].values()))
                for task, part in parts.items()
            }
        make = functools.partial(
            make_one,
            self.gym_id,
            self.disable_env_checker,
            self.gym_kwargs,
            (self.task_config().task, self.instructions),
        )
        if use_async_envs and n_envs > 1:
            # As LeRobot does: a fork would copy the GL context and torch's threads.
            vector: VectorEnv = AsyncVectorEnv(
                [make] * n_envs, context="forkserver", autoreset_mode=AutoresetMode.SAME_STEP
            )
        else:
            vector = SyncVectorEnv([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)
        return {self.type: {0: vector}}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return the processors between env and policy: the encoder, if there is one."""
        steps = []
        if self.encoder:
            steps = [
                EncodeViews(self.encoder, self.views, self.encoder_weights, self.encoder_sha256)
            ]
        return PolicyProcessorPipeline(steps=steps), PolicyProcessorPipeline(steps=[])


def make_one(
    gym_id: str,
    disable_env_checker: bool,
    arguments: dict[str, Any],
    told: tuple[str, str] | None = None,
) -> gymnasium.Env:
    """Make one env; `told` is its task and the bank of its instructions.

    It is a function of this module so that a worker process that unpickles it registers the ids.
    """
    env = gymnasium.make(gym_id, disable_env_checker=disable_env_checker, **arguments)
    if told is not None and told[1] != STANDARD:
        env = Instructed(env, *told)
    frozen: gymnasium.Env = FreezeAfterEpisodeEnd(NestImages(env))
    return frozen


class Instructed(gymnasium.Wrapper):
    """Describe the task with a sentence that is drawn by each episode's seed.

    Attributes:
        task_description: the sentence of the present episode.
    """

    def __init__(self, env: gymnasium.Env, task: str, bank: str):
        super().__init__(env)
        self._task = task
        self._bank = bank
        self._episodes = 0
        self.task_description = draw_instruction(task, bank, 0)

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; its seed, or without one its number, decides the sentence."""
        seed = arguments.get("seed")
        self._episodes += 1
        self.task_description = draw_instruction(
            self._task, self._bank, self._episodes if seed is None else int(seed)
        )
        result: tuple[Any, dict[str, Any]] = self.env.reset(**arguments)
        return result


class NestImages(gymnasium.ObservationWrapper):
    """Arrange an env's images as LeRobot expects them: by view, under the one key "pixels"."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        flat = env.observation_space
        assert isinstance(flat, spaces.Dict)
        images = {view: space for view, space in flat.spaces.items() if view != AGENT_POS}
        self.observation_space = spaces.Dict(
            {"pixels": spaces.Dict(images), AGENT_POS: flat[AGENT_POS]}
        )

    def observation(self, observation: dict[str, NDArray[np.float32]]) -> dict[str, object]:
        """Return the observation with its images under "pixels"."""
        images = {view: frame for view, frame in observation.items() if view != AGENT_POS}
        return {"pixels": images, AGENT_POS: observation[AGENT_POS]}
