"""LeRobot's policies in our evaluation: `evaluate` takes a checkpoint of `lerobot-train`.

Interface:

* `find(folder) -> Path | None`: the folder with config.json and model.safetensors, looked for in a
  training's output, in one of its checkpoints, or in `pretrained_model` itself.
* `read(folder, task) -> LeRobotCheckpoint`: what the policy was trained for and what it sees.
* `LeRobotAgent`: the policy as an agent.

A policy with seven action values moves the active arm by increments and sees its pose. One with
sixteen outputs both arms' set-points and sees both poses (`envs.absolute`), as policies trained on
datasets of layout "open-h" or on the field's own do. Images may have their names in those datasets
(`dataset.open_h`).

The policy runs through LeRobot's own pipeline, as in `lerobot-eval`. So that a result depends
neither on the batch nor on the processes, every slot has its own policy (sharing weights) with its
own random numbers, drawn from the episode's seed; a policy that declares itself `memoryless` gets
all slots in one batch. Importing LeRobot takes ten seconds and happens only in the worker.

A checkpoint names the steps of that pipeline, and LeRobot calls what it names. Only steps of
LeRobot and of installed plug-ins are called (`lerobot_steps`).
"""

import contextlib
import copy
import dataclasses
import itertools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names, check_camera
from surgicai_vision.core.config import TaskConfig, digest, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, SurgicaiError, check_name
from surgicai_vision.core.files import read_json, sha256_file
from surgicai_vision.core.untrusted import checked
from surgicai_vision.dataset import open_h
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    Observation,
    Robot,
    frame_of,
    simulated,
)
from surgicai_vision.evaluation.lerobot_steps import check_steps
from surgicai_vision.features.devices import (
    cuda_devices,
    random_states,
    seeded_random_states,
    set_random_states,
)
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource, load_encoder
from surgicai_vision.training.run_config import OWN
from surgicai_vision.training.threads import one_thread

if TYPE_CHECKING:
    import torch

    from encoders.base import Encoder

CONFIG, WEIGHTS, TRAINING = "config.json", "model.safetensors", "train_config.json"
PROCESSORS = "policy_*processor*"
"""Files of the processing around a policy: its steps and their normalisers."""
PLACES = ("", "pretrained_model", "checkpoints/last/pretrained_model")
"""Where a checkpoint may be in a folder that the user names."""
ENV_TYPE = "surgicai"
VISUAL = "VISUAL"
ABSOLUTE_SIZE = len(names.ABSOLUTE_ACTION_NAMES)


class LeRobotPolicy(Protocol):
    """The part of LeRobot's `PreTrainedPolicy` that acting uses."""

    def parameters(self) -> "Iterator[torch.Tensor]":
        """Yield the trained tensors."""

    def buffers(self) -> "Iterator[torch.Tensor]":
        """Yield the other tensors of its state."""

    def reset(self) -> None:
        """Forget the last episode."""

    def select_action(self, batch: Mapping[str, object]) -> "torch.Tensor":
        """Return the actions (n, 7) of a batch of observations."""


type Before = Callable[[Mapping[str, object]], Mapping[str, object]]
type After = "Callable[[torch.Tensor], torch.Tensor]"
"""LeRobot's processing around a policy: of the observations, and of the actions."""


def find(folder: Path) -> Path | None:
    """Return the folder of LeRobot's checkpoint in `folder`, or None where there is none."""
    for place in PLACES:
        candidate = folder / place
        if (candidate / CONFIG).is_file() and (candidate / WEIGHTS).is_file():
            return candidate
    return None


@dataclass(frozen=True)
class Inputs:
    """What the policy sees.

    Attributes:
        cameras: views.
        image_size: height and width of their images [px].
        encoder: encoder whose features it sees instead of images; None for images.
        sha256: hash of that encoder's weights; empty where unknown.
        image_names: what the policy calls the views' images after `observation.images.`; empty for
            the views' own names.
        action_mode: one of `names.ACTION_MODES`.
    """

    cameras: tuple[str, ...]
    image_size: int
    encoder: str | None = None
    sha256: str = ""
    image_names: tuple[str, ...] = ()
    action_mode: str = names.INCREMENTS

    @property
    def shown(self) -> Mapping[str, str]:
        """View → what the policy calls its images."""
        return dict(zip(self.cameras, self.image_names or self.cameras, strict=True))


@dataclass(frozen=True)
class LeRobotCheckpoint:
    """What is known of a checkpoint without loading it.

    Attributes:
        policy: LeRobot's type of the policy.
        config: the task it was trained for.
        inputs: what it sees.
        encoder: the frozen encoder, ours or the policy's own; None for a policy without images.
        policy_sha256: hash of its weights.
        settings_sha256: hash of its settings and normalisers, which decide how the weights act.
    """

    policy: str
    config: TaskConfig
    inputs: Inputs
    encoder: str | None
    policy_sha256: str
    settings_sha256: str


def read(folder: Path, task: str | None = None) -> LeRobotCheckpoint:
    """Read a checkpoint folder of `find`.

    Args:
        folder: holds config.json and model.safetensors.
        task: the task, where the checkpoint does not name it.

    Raises:
        BadFile: a checkpoint that is damaged.
        InputError: a policy that sees what our envs do not show.
    """
    policy = _table(folder / CONFIG)
    training = _table(folder / TRAINING) if (folder / TRAINING).is_file() else {}
    config, inputs = _circumstances(training, folder, task, policy)
    named = inputs.encoder or policy.get("encoder")
    encoder = (named or OWN) if inputs.cameras else None
    settings = sorted([folder / CONFIG, *folder.glob(PROCESSORS)])
    return LeRobotCheckpoint(
        str(policy["type"]),
        config,
        inputs,
        encoder,
        policy_sha256=sha256_file(folder / WEIGHTS),
        settings_sha256=digest({path.name: sha256_file(path) for path in settings}),
    )


def _circumstances(
    training: Mapping[str, Any], folder: Path, task: str | None, policy: Mapping[str, Any]
) -> tuple[TaskConfig, Inputs]:
    """Return the task the policy was trained for and what it sees.

    They come from its env, its dataset or `task`.
    """
    path = folder / TRAINING
    env = _part(path, training, "env")
    root = checked(_part(path, training, "dataset").get("root") or "", str, f"{path}: root")
    features: Inputs | None = None
    if env.get("type") == ENV_TYPE:
        fields = {
            field.name: env[field.name]
            for field in dataclasses.fields(TaskConfig)
            if field.name in env
        }
        config = from_mapping(TaskConfig, fields, str(path))
        if env.get("encoder"):
            _check_keys(path, env, "cameras", "image_size")
            sha256 = env.get("encoder_sha256", "")
            features = _features(path, env["encoder"], env["cameras"], sha256, env["image_size"])
    elif root and (Path(root) / names.META_FILE).is_file():
        path = Path(root) / names.META_FILE
        meta = _table(path)
        _check_keys(path, meta, "task_config")
        config = from_mapping(TaskConfig, meta["task_config"], str(path))
        exported = _part(path, meta, "features")
        if exported:
            _check_keys(path, meta, "image_size")
            _check_keys(path, exported, "encoder", "views", "weights_sha256")
            features = _features(
                path,
                exported["encoder"],
                exported["views"],
                exported["weights_sha256"],
                meta["image_size"],
            )
    elif task:
        config = TaskConfig(task=task)
    else:
        raise InputError(f"{folder} does not name the task it was trained for; give --task.")
    seen = policy.get("input_features") or {}
    action_mode = _action_mode(folder, seen, policy.get("output_features") or {})
    if action_mode == names.ABSOLUTE and (config.hold_jaw or config.randomisation.latency):
        raise InputError(
            f"{folder} gives both arms' set-points, but its env changes increments (hold_jaw or "
            "latency); train it in an env without."
        )
    inputs = _inputs(folder, seen, features)
    return config, dataclasses.replace(inputs, action_mode=action_mode)


def _action_mode(folder: Path, seen: Mapping[str, Any], said: Mapping[str, Any]) -> str:
    """Return a policy's action mode, by its number of values; its state must have as many.

    Raises:
        InputError: actions that our envs do not take.
    """
    sizes = {len(names.ACTION_NAMES): names.INCREMENTS, ABSOLUTE_SIZE: names.ABSOLUTE}
    for key, features in ((names.ACTION, said), (names.STATE, seen)):
        shape = features.get(key, {}).get("shape")
        if shape is not None and (len(shape) != 1 or shape[0] not in sizes):
            raise InputError(
                f"{folder}: its {key} has shape {shape}; our envs have 7 values of the active arm "
                "or 16 of both (PSM1 then PSM2: position, quaternion x y z w, jaw)."
            )
    shapes = [
        features.get(key, {}).get("shape")
        for key, features in ((names.ACTION, said), (names.STATE, seen))
    ]
    known = {shape[0] for shape in shapes if shape}
    if len(known) > 1:
        raise InputError(
            f"{folder} has {shapes[1][0]} values of state and {shapes[0][0]} of action; our envs "
            "have 7 of both or 16 of both."
        )
    return sizes[known.pop()] if known else names.INCREMENTS


def _features(path: Path, encoder: object, views: object, sha256: object, size: object) -> Inputs:
    """Return what a policy sees that sees features, as the file `path` says it.

    Raises:
        BadFile: a value is of another type.
        UnknownName: no such camera.
    """
    cameras = checked(views, list, f"{path}: cameras")
    return Inputs(
        tuple(check_camera(checked(camera, str, f"{path}: a camera")) for camera in cameras),
        checked(size, int, f"{path}: image_size"),
        checked(encoder, str, f"{path}: encoder"),
        checked(sha256, str, f"{path}: the hash of the encoder's weights"),
    )


def _inputs(folder: Path, seen: Mapping[str, Any], features: Inputs | None) -> Inputs:
    """Return what a policy with these inputs sees."""
    if names.ENVIRONMENT_STATE in seen:
        if features is None:
            raise InputError(
                f"{folder} sees {names.ENVIRONMENT_STATE}, and neither its env nor its dataset "
                "names its encoder; train it on an exported dataset of ours."
            )
        return features
    shapes = {key: value["shape"] for key, value in seen.items() if value["type"] == VISUAL}
    known = {names.image_key(view): view for view in camera_names()}
    known |= {open_h.image_key(view): view for view in open_h.IMAGES}
    for key in shapes:
        check_name(f"image of {folder}", key, known)
    sizes = {tuple(shape[1:]) for shape in shapes.values()}
    if len(sizes) > 1 or any(height != width for height, width in sizes):
        raise InputError(
            f"{folder} sees images of {sorted(sizes)}; our envs show square ones of one size."
        )
    return Inputs(
        tuple(known[key] for key in shapes),
        next(iter(sizes))[0] if sizes else 224,
        image_names=tuple(key.removeprefix(names.image_key("")) for key in shapes),
    )


def _table(path: Path) -> dict[str, Any]:
    """Return a JSON table."""
    content = read_json(path)
    if not isinstance(content, dict) or (path.name == CONFIG and not content.get("type")):
        raise BadFile(f"{path} is not a LeRobot configuration.")
    if path.name == CONFIG:
        _check_features(path, content)
    return content


def _check_features(path: Path, policy: Mapping[str, Any]) -> None:
    """Refuse a policy's configuration whose features have no type or no shape."""
    for kind in ("input_features", "output_features"):
        for key, feature in _part(path, policy, kind).items():
            if not _is_feature(feature):
                raise BadFile(
                    f"{path} is damaged: '{key}' of {kind} has no type or no shape; "
                    "copy the checkpoint again."
                )


def _is_feature(feature: object) -> bool:
    """Return True for a table with a feature's type and shape; an image's shape has three sizes."""
    if not isinstance(feature, dict) or not isinstance(feature.get("type"), str):
        return False
    shape = feature.get("shape")
    if not isinstance(shape, list) or not all(type(size) is int for size in shape):
        return False
    return feature["type"] != VISUAL or len(shape) == 3


def _part(path: Path, table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a table within a table of the file `path`; empty where there is none."""
    part = table.get(key) or {}
    if not isinstance(part, dict):
        raise BadFile(f"{path} is damaged: '{key}' is not a table; copy it again.")
    return part


def _check_keys(path: Path, table: Mapping[str, Any], *keys: str) -> None:
    """Refuse a table of the file `path` that lacks one of `keys`."""
    for key in keys:
        if key not in table:
            raise BadFile(f"{path} is damaged: '{key}' is missing; copy it again.")


@final
class LeRobotAgent(Agent):
    """A policy of LeRobot.

    Args:
        name: its name in tables.
        folder: its checkpoint.
        inputs: what it sees.
        text: the task in words, as in its dataset.
        weights: where pretrained weights come from.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        inputs: Inputs,
        text: str,
        weights: WeightsSource = ANYWHERE,
    ):
        self.name = name
        self.cameras = inputs.cameras
        self.image_size = inputs.image_size
        self.action_mode = inputs.action_mode
        # Both arms' poses are read from the env itself (`_state`); no driver provides them yet.
        self.privileged = inputs.action_mode == names.ABSOLUTE
        self._shown = inputs.shown
        self._policy, self._before, self._after = _load(folder, weights)
        self._text = text
        self._together = bool(getattr(self._policy, "memoryless", False))
        self._encoder = _encoder(inputs, weights) if inputs.encoder else None
        self._device = next(self._policy.parameters()).device
        self._slots: dict[int, tuple[LeRobotPolicy, dict[str, torch.Tensor]]] = {}

    def reset(self, slot: int, robot: Robot, seed: int) -> None:
        """Give the slot a policy that remembers nothing, and the random numbers of `seed`."""
        policy = self._policy
        if not self._together:
            tensors = itertools.chain(policy.parameters(), policy.buffers())
            policy = copy.deepcopy(policy, {id(tensor): tensor for tensor in tensors})
        policy.reset()
        self._slots[slot] = policy, seeded_random_states(self._device, seed)

    def restart(self, slot: int) -> None:
        """Forget what the slot's policy has planned: a subtask begins."""
        self._slots[slot][0].reset()

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the policy's actions, (n, 7) or (n, 16)."""
        import torch

        cuda = cuda_devices(self._device)
        with one_thread(), torch.inference_mode(), torch.random.fork_rng(devices=cuda):
            if self._together:
                return self._act(self._policy, robots, observations)
            actions = []
            for slot, robot, observation in zip(slots, robots, observations, strict=True):
                policy, states = self._slots[slot]
                set_random_states(states, self._device)
                actions.append(self._act(policy, [robot], [observation]))
                self._slots[slot] = policy, random_states(self._device)
            return np.concatenate(actions)

    def _state(self, robots: Sequence[Robot]) -> NDArray[np.float32]:
        """Return what the policy sees of the arms, (n, 7) or (n, 16).

        It is read from the robot: another arm may have become active since the observation.
        """
        if self.action_mode == names.ABSOLUTE:
            return np.stack([simulated(robot).absolute_pos() for robot in robots])
        return np.stack([robot.agent_pos() for robot in robots])

    def _act(
        self, policy: LeRobotPolicy, robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Ask one policy for the actions of a batch, through LeRobot's pipeline."""
        import torch
        from lerobot.envs.utils import preprocess_observation

        raw: dict[str, object] = {"agent_pos": self._state(robots)}
        if self._encoder is None:
            raw["pixels"] = {
                shown: np.stack([frame_of(o, view) for o in observations])
                for view, shown in self._shown.items()
            }
        else:
            views = [
                self._encoder(np.stack([frame_of(o, view) for o in observations]))
                for view in self.cameras
            ]
            raw["environment_state"] = np.concatenate(views, axis=1)
        batch = {
            **preprocess_observation(raw),
            "task": [self._text] * len(robots),
        }
        action = self._after(policy.select_action(self._before(batch)))
        return np.asarray(action.to("cpu", torch.float32).numpy(), np.float32)


def _load(folder: Path, weights: WeightsSource) -> tuple[LeRobotPolicy, Before, After]:
    """Return policy, pre- and post-processor.

    Plug-ins are found as LeRobot's own commands find them.
    """
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.processor import ProcessorStep
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    check_steps(folder, ProcessorStep)
    try:
        config = PreTrainedConfig.from_pretrained(folder)
        # The checkpoint holds the backbone; LeRobot would download it first, only to overwrite it.
        if getattr(config, "pretrained_backbone_weights", None):
            config.pretrained_backbone_weights = None
        own = weights.file_for(str(getattr(config, "encoder", None)))
        if own and hasattr(config, "encoder_weights"):
            config.encoder_weights = str(own)
        with contextlib.redirect_stdout(
            sys.stderr
        ):  # LeRobot prints; our standard output is the result
            policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        overrides = {"device_processor": {"device": config.device}}
        before, after = make_pre_post_processors(
            config, str(folder), preprocessor_overrides=overrides
        )
    except SurgicaiError:
        raise
    except Exception as error:
        raise BadFile(
            f"LeRobot cannot load {folder} ({(str(error).splitlines() or [''])[0]})."
        ) from error
    return policy.eval(), before, after


def _encoder(inputs: Inputs, weights: WeightsSource) -> "Encoder":
    """Load the encoder whose features the policy sees, verified."""
    encoder = load_encoder(str(inputs.encoder), weights=weights)
    if inputs.sha256 and encoder.weights_sha256 != inputs.sha256:
        raise InputError(
            f"The policy was trained on encoder '{inputs.encoder}' with weights sha256 "
            f"{inputs.sha256}, got {encoder.weights_sha256}; give the same weights with --weights."
        )
    return encoder
