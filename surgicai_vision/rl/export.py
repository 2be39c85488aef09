"""Export: transitions in the formats of other libraries.

    write(transitions, "d3rlpy", Path("outputs/transitions/grasp"))

| format | file in the folder | read by |
|---|---|---|
| npz | `transitions.npz` | `numpy.load`, `transitions.read_transitions` |
| sb3 | `buffer.pkl` | `model.load_replay_buffer`; of obs_type "goal" a `HerReplayBuffer` |
| d3rlpy | `dataset.h5` | `d3rlpy.dataset.ReplayBuffer.load(file, InfiniteBuffer())` |
| minari | `minari/` | `minari.load_dataset(id)` with `MINARI_DATASETS_PATH` there |
| robomimic | `demo.hdf5` | robomimic's `SequenceDataset`, and `train.py` with it |

A Minari dataset records its env: `recover_environment()` returns the env of the transitions, and
its episodes' seeds are those of their starts.

robomimic's observation keys are `flat` for an array, as in its `EnvGym`, and the three parts for a
goal dict. Every tenth demonstration is in the mask `valid`, the others are in `train`. robomimic
creates envs of the old package gym, whose steps return four values, so train with
`experiment.rollout.enabled` false and evaluate elsewhere.

`fill(buffer, transitions)` adds them to the replay buffer of your own Stable-Baselines3 model,
HER's included. d3rlpy keeps no observation after the last action of an episode. It does not need
one, because an episode ends with its success.
"""

import copy
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.core.files import write_bytes, write_json
from surgicai_vision.core.tasks import env_id
from surgicai_vision.envs.base import most_actions
from surgicai_vision.envs.observation import ObservationConfig
from surgicai_vision.rl.extra import check_extra
from surgicai_vision.rl.transitions import OBSERVATION, Transitions, write_transitions

if TYPE_CHECKING:
    from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer

CARD = "transitions.json"
"""File that describes what the folder holds; written last."""
ROBOMIMIC_GYM = 2
"""`EnvType.GYM_TYPE` of robomimic 0.3 (robomimic/envs/env_base.py)."""
ROBOMIMIC_FLAT = "flat"
"""robomimic's key of an observation that is one array (robomimic/envs/env_gym.py)."""
VALID_EVERY = 10
"""One demonstration in this many is for validation, as in robomimic's split_train_val.py."""
ACTIONS = spaces.Box(-1.0, 1.0, (7,), np.float32)


def write(transitions: Transitions, format: str, out: Path) -> Path:
    """Write transitions into a folder; return the file or folder that a library reads.

    An earlier export in the same format is replaced.

    Args:
        transitions: transitions of one env.
        format: one of `FORMATS`.
        out: the folder, which is created.

    Raises:
        InputError: the format's package is not installed, or takes no goal dicts.
    """
    check_name("format", format, FORMATS)
    check_extra(f"--format {format}", *PACKAGES[format])
    out.mkdir(parents=True, exist_ok=True)
    written = out / FILES[format]
    FORMATS[format](transitions, written)
    write_json(
        out / CARD,
        {
            "task": transitions.config.task,
            "obs_type": transitions.obs_type,
            "format": format,
            "transitions": len(transitions),
            "episodes": transitions.episodes,
            "failed": transitions.failed,
            "demos": transitions.demos,
        },
    )
    return written


def _write_npz(transitions: Transitions, path: Path) -> None:
    write_transitions(path, transitions)


def _write_sb3(transitions: Transitions, path: Path) -> None:
    from stable_baselines3.common.save_util import save_to_pkl

    content = io.BytesIO()
    save_to_pkl(content, buffer_of(transitions))
    write_bytes(path, content.getvalue())


def _write_d3rlpy(transitions: Transitions, path: Path) -> None:
    from d3rlpy.dataset import MDPDataset

    dataset = MDPDataset(
        observations=transitions.vector,
        actions=transitions.action,
        rewards=transitions.reward,
        terminals=transitions.terminated.astype(np.float32),
        timeouts=(ends(transitions) & ~transitions.terminated).astype(np.float32),
    )
    content = io.BytesIO()
    dataset.dump(content)
    write_bytes(path, content.getvalue())


def _write_minari(transitions: Transitions, folder: Path) -> None:
    os.environ["MINARI_DATASETS_PATH"] = str(folder.absolute())
    import minari
    from minari.data_collector import EpisodeBuffer

    config = transitions.config
    dataset_id = f"surgicai/{config.task}/{transitions.obs_type}-v0"
    if (folder / dataset_id).exists():
        shutil.rmtree(folder / dataset_id)  # Minari does not replace a dataset
    episodes = [
        EpisodeBuffer(
            id=index,
            seed=int(transitions.seeds[index]) if transitions.seeds[index] >= 0 else None,
            observations=_whole(transitions, rows),
            actions=transitions.action[rows],
            rewards=transitions.reward[rows].tolist(),
            terminations=transitions.terminated[rows].tolist(),
            truncations=transitions.truncated[rows].tolist(),
        )
        for index, rows in enumerate(_rows(transitions))
    ]
    minari.create_dataset_from_buffers(
        dataset_id,
        episodes,
        env=spec_of(transitions),
        action_space=ACTIONS,
        observation_space=space_of(transitions),
        algorithm_name="surgicai-vision demonstrations",
        description=f"{env_id(config.task)}, obs_type {transitions.obs_type}, "
        f"reward {config.reward}; {json.dumps({'demos': transitions.demos})}",
    )


def _write_robomimic(transitions: Transitions, path: Path) -> None:
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = len(transitions)
        spec = spec_of(transitions)
        data.attrs["env_args"] = json.dumps(
            {"env_name": spec.id, "type": ROBOMIMIC_GYM, "env_kwargs": spec.kwargs}
        )
        data.attrs["demos"] = transitions.demos
        masks: dict[str, list[bytes]] = {"train": [], "valid": []}
        for index, rows in enumerate(_rows(transitions)):
            name = f"demo_{index}"
            demo = data.create_group(name)
            demo.attrs["num_samples"] = rows.stop - rows.start
            demo.attrs["seed"] = int(transitions.seeds[index])
            demo["actions"] = transitions.action[rows]
            demo["rewards"] = transitions.reward[rows]
            demo["dones"] = ends(transitions)[rows].astype(np.int64)
            for part, values in (
                ("obs", transitions.observation),
                ("next_obs", transitions.next_observation),
            ):
                for key, column in values.items():
                    shown = key if transitions.is_goal else ROBOMIMIC_FLAT
                    demo[f"{part}/{shown}"] = column[rows]
            is_held_out = index % VALID_EVERY == VALID_EVERY - 1
            masks["valid" if is_held_out else "train"].append(name.encode())
        for mask, demos in masks.items():
            if demos:
                file[f"mask/{mask}"] = np.array(demos)
    write_bytes(path, content.getvalue())


FORMATS: Mapping[str, Callable[[Transitions, Path], None]] = MappingProxyType(
    {
        "npz": _write_npz,
        "sb3": _write_sb3,
        "d3rlpy": _write_d3rlpy,
        "minari": _write_minari,
        "robomimic": _write_robomimic,
    }
)
"""Format → function that writes it to a path."""
FILES: Mapping[str, str] = MappingProxyType(
    {
        "npz": "transitions.npz",
        "sb3": "buffer.pkl",
        "d3rlpy": "dataset.h5",
        "minari": "minari",
        "robomimic": "demo.hdf5",
    }
)
"""Format → name of its file or folder, which a killed export may leave without the card."""
PACKAGES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "npz": (),
        "sb3": ("stable_baselines3",),
        "d3rlpy": ("d3rlpy",),
        "minari": ("minari",),
        "robomimic": ("h5py",),
    }
)
"""Format → packages that must be installed."""


def spec_of(transitions: Transitions) -> EnvSpec:
    """Return the gymnasium spec of the env of transitions, with its arguments."""
    spec = copy.deepcopy(gymnasium.spec(env_id(transitions.config.task)))
    options = to_mapping(transitions.config)
    del options["task"], options["max_steps"]
    spec.kwargs.update(options, obs_type=transitions.obs_type)
    spec.max_episode_steps = most_actions(transitions.config)
    return spec


def space_of(transitions: Transitions) -> spaces.Space[object]:
    """Return the observation space of transitions."""
    return ObservationConfig(transitions.obs_type).space()


def buffer_of(transitions: Transitions) -> "ReplayBuffer":
    """Return a replay buffer of Stable-Baselines3 that holds only the transitions.

    For obs_type "goal" it is a `HerReplayBuffer`; give it an env (`set_env`) before it relabels.
    """
    from stable_baselines3 import HerReplayBuffer
    from stable_baselines3.common.buffers import ReplayBuffer
    from stable_baselines3.common.vec_env import VecEnv

    space = space_of(transitions)
    buffer: ReplayBuffer
    if isinstance(space, spaces.Dict):
        without = cast(VecEnv, None)
        buffer = HerReplayBuffer(len(transitions), space, ACTIONS, env=without, device="cpu")
    else:
        buffer = ReplayBuffer(len(transitions), space, ACTIONS, device="cpu")
    fill(buffer, transitions)
    return buffer


def fill(buffer: "BaseBuffer", transitions: Transitions) -> None:
    """Add transitions to a replay buffer of Stable-Baselines3 for one env, in their order.

    Args:
        buffer: a `ReplayBuffer`, or a `HerReplayBuffer` for goal dicts.
        transitions: transitions whose observations fit the buffer's space.

    Raises:
        InputError: a buffer of several envs, or one that holds fewer transitions.
    """
    if buffer.n_envs != 1:
        raise InputError(
            f"The buffer is for {buffer.n_envs} parallel envs, but demonstrations are one "
            "sequence; give a model with one env."
        )
    if buffer.buffer_size < len(transitions):
        raise InputError(
            f"The buffer holds {buffer.buffer_size} transitions, and there are "
            f"{len(transitions)}; give a model with a larger buffer_size."
        )
    last = ends(transitions)
    for row in range(len(transitions)):
        buffer.add(
            _at(transitions, transitions.observation, row),
            _at(transitions, transitions.next_observation, row),
            transitions.action[row : row + 1],
            transitions.reward[row : row + 1],
            last[row : row + 1],
            [{"TimeLimit.truncated": bool(last[row] and not transitions.terminated[row])}],
        )


def ends(transitions: Transitions) -> NDArray[np.bool_]:
    """Return whether each transition is its episode's last, (N,)."""
    after = np.append(transitions.episode[1:], -1)
    last: NDArray[np.bool_] = after != transitions.episode
    return last


def _at(
    transitions: Transitions, parts: Mapping[str, NDArray[np.float32]], row: int
) -> NDArray[np.float32] | dict[str, NDArray[np.float32]]:
    """Return one observation as a batch of one."""
    if transitions.is_goal:
        return {key: part[row : row + 1] for key, part in parts.items()}
    return parts[OBSERVATION][row : row + 1]


def _rows(transitions: Transitions) -> Iterator[slice]:
    """Yield the rows of each episode."""
    stops = np.flatnonzero(ends(transitions)) + 1
    start = 0
    for stop in stops.tolist():
        yield slice(start, stop)
        start = stop


def _whole(
    transitions: Transitions, rows: slice
) -> NDArray[np.float32] | dict[str, NDArray[np.float32]]:
    """Return an episode's T + 1 observations."""
    parts = {
        key: np.concatenate([part[rows], transitions.next_observation[key][rows][-1:]])
        for key, part in transitions.observation.items()
    }
    return parts if transitions.is_goal else parts[OBSERVATION]
