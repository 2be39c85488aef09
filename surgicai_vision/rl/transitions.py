"""Transitions: demonstrations as reinforcement learning reads them.

A demonstration holds states and actions, but no observations. `of_demos` replays its executed
actions from its first state in an env with the requested observations. Every transition is
therefore the env's own: another replay gives the same reward and next observation, bit for bit.

    transitions = of_demos(list_demos(folder), TaskConfig("grasp"), "goal")
    transitions.observation["desired_goal"], transitions.action, transitions.reward, …

An episode ends with its first success, as in the env; what was recorded after it is left out. With
`action_repeat` the replay uses the mean of that many actions, and with `hold_jaw` the jaw's action
is 0; the few demonstrations that then fail are left out and counted.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision import envs
from surgicai_vision.core.config import SuccessRule, TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, check_name
from surgicai_vision.core.files import write_bytes
from surgicai_vision.core.progress import Progress
from surgicai_vision.core.untrusted import checked, parse_json
from surgicai_vision.demos.store import Demo, demos_digest, read_demo
from surgicai_vision.envs.base import Observation, SuturingEnv

OBSERVATION = "observation"
"""Key of an observation that is one array, and of the proprioception of a goal dict."""
OBS_TYPES = ("relative", "state", "goal")
"""Observation types that transitions may have: arrays of numbers."""
VERSION = 1
DAMAGED = (
    *(OSError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError),
    *(ValueError, KeyError, TypeError),
)
"""What reading a damaged file, or one of something else, raises."""

Arrays = Mapping[str, NDArray[np.float32]]


@final
@dataclass(frozen=True)
class Transitions:
    """N transitions of E episodes, episode by episode.

    Attributes:
        config: the task, with the options of the env.
        obs_type: what is observed, one of `OBS_TYPES`.
        observation: key → (N, …) float32 before each action; for obs_type "goal" its three parts,
            otherwise only the key `OBSERVATION`.
        next_observation: the same after it.
        action: the executed actions, (N, 7) float32.
        reward: (N,) float32.
        terminated: the task was solved, (N,) bool.
        truncated: the episode or the recording ended otherwise, (N,) bool.
        episode: 0 … E - 1, (N,) int64.
        seeds: seed of each episode's start, (E,) int64; -1 where it has none.
        demos: sha256 over the files they come from.
        failed: demonstrations left out, because they did not succeed in this env.
    """

    config: TaskConfig
    obs_type: str
    observation: Arrays
    next_observation: Arrays
    action: NDArray[np.float32]
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    episode: NDArray[np.int64]
    seeds: NDArray[np.int64]
    demos: str
    failed: int = 0

    def __len__(self) -> int:
        """Return the number of transitions N."""
        return len(self.action)

    @property
    def episodes(self) -> int:
        """Return the number of episodes E."""
        return len(self.seeds)

    @property
    def is_goal(self) -> bool:
        """Return True for goal dicts."""
        return self.obs_type == "goal"

    @property
    def vector(self) -> NDArray[np.float32]:
        """Return the observations of an obs_type that is one array, (N, n)."""
        self._check_array()
        return self.observation[OBSERVATION]

    @property
    def next_vector(self) -> NDArray[np.float32]:
        """Return the next observations of an obs_type that is one array, (N, n)."""
        self._check_array()
        return self.next_observation[OBSERVATION]

    def _check_array(self) -> None:
        if self.is_goal:
            raise InputError(
                "obs_type 'goal' is a dict, which this library does not take; "
                "give relative or state."
            )


def of_demos(
    paths: Sequence[Path],
    config: TaskConfig | None = None,
    obs_type: str = "relative",
    progress: Progress | None = None,
    success_rule: SuccessRule = SuccessRule(),
) -> Transitions:
    """Replay demonstrations and return their transitions.

    Args:
        paths: episode files.
        config: the env they are replayed in; reward, tolerance, limit and options may differ from
            those they were recorded in. None uses the recorded one.
        obs_type: what is observed, one of `OBS_TYPES`.
        progress: called with (demonstrations done, in total).
        success_rule: what a success requires beyond the paper's rule.

    Raises:
        InputError: demonstrations of another task, scene, step size or randomisation, or none that
            succeeds in this env.
        BadFile: a damaged file.
    """
    check_name("obs_type of transitions", obs_type, OBS_TYPES)
    if not paths:
        raise InputError("There are no demonstrations; give at least one.")
    env: SuturingEnv | None = None
    episodes: list[_Episode] = []
    seeds: list[int] = []
    for index, path in enumerate(paths):
        demo = read_demo(path)
        config = config or demo.config
        if env is None:
            env = envs.make(config, obs_type)
            env.success_rule = success_rule
        _check(path, demo, env)
        episode = _replay(env, demo)
        if episode.terminated:
            episodes.append(episode)
            seeds.append(demo.seed)
        if progress:
            progress(index + 1, len(paths))
    assert env is not None and config is not None
    env.close()
    if not episodes:
        raise InputError(
            f"None of {len(paths)} demonstrations succeeds when replayed with these options; "
            "record them in this env, or leave the options out; where a success must hold, also "
            "record the steps after it (--post-success-steps)."
        )
    return Transitions(
        config=config,
        obs_type=obs_type,
        observation=_joined([episode.seen[:-1] for episode in episodes]),
        next_observation=_joined([episode.seen[1:] for episode in episodes]),
        action=np.concatenate([episode.actions for episode in episodes]),
        reward=np.concatenate([np.array(episode.rewards, np.float32) for episode in episodes]),
        terminated=np.concatenate([_last(len(episode.rewards)) for episode in episodes]),
        truncated=np.zeros(sum(len(episode.rewards) for episode in episodes), bool),
        episode=np.repeat(
            np.arange(len(episodes)), [len(episode.rewards) for episode in episodes]
        ).astype(np.int64),
        seeds=np.array(seeds, np.int64),
        demos=demos_digest(list(paths)),
        failed=len(paths) - len(episodes),
    )


@dataclass(frozen=True)
class _Episode:
    """One replayed demonstration: T + 1 observations, T actions and rewards."""

    seen: list[Observation]
    actions: NDArray[np.float32]
    rewards: list[float]
    terminated: bool


def _check(path: Path, demo: Demo, env: SuturingEnv) -> None:
    """Refuse a demonstration recorded in another env than the one it is to be replayed in."""
    for name in ("task", "step", "randomisation"):
        recorded = getattr(demo.config, name)
        wanted = getattr(env.config, name)
        if recorded != wanted:
            raise InputError(
                f"{path} was recorded with {name} {recorded}, but is to be replayed with "
                f"{wanted}; give demonstrations of this env."
            )
    if demo.scene_hash != env.scene.hash:
        raise InputError(
            f"{path} was recorded in another scene ({demo.scene_hash[:8]}, this one is "
            f"{env.scene.hash[:8]}); record demonstrations in this one."
        )


def _replay(env: SuturingEnv, demo: Demo) -> _Episode:
    """Replay a demonstration's executed actions from its first state to its success."""
    executed = demo.action if demo.executed is None else demo.executed
    repeat = env.config.action_repeat
    env.set_state_vector(demo.state[0])
    seen = [env.observe()]
    actions: list[NDArray[np.float32]] = []
    rewards: list[float] = []
    terminated = False
    for start in range(0, len(executed), repeat):
        action = executed[start : start + repeat].mean(axis=0, dtype=np.float32)
        if env.config.hold_jaw and env.subtask.starts_held:
            action[6] = 0.0
        observation, reward, _, truncated, info = env.step(action)
        seen.append(observation)
        actions.append(action)
        rewards.append(reward)
        terminated = bool(info["is_success"])
        if terminated or truncated or info["physics_error"]:
            break
    return _Episode(seen, np.stack(actions), rewards, terminated)


def _joined(parts: Sequence[Sequence[Observation]]) -> dict[str, NDArray[np.float32]]:
    """Return observations, episode by episode, as one array per key."""
    rows = [
        row if isinstance(row, Mapping) else {OBSERVATION: row} for part in parts for row in part
    ]
    return {key: np.stack([row[key] for row in rows]).astype(np.float32) for key in rows[0]}


def _last(steps: int) -> NDArray[np.bool_]:
    """Return (steps,) bool, True only at the end."""
    last: NDArray[np.bool_] = np.arange(steps) == steps - 1
    return last


def write_transitions(path: Path, transitions: Transitions) -> None:
    """Write transitions as one npz file: one array per field, observation keys after a dot."""
    content = io.BytesIO()
    about = {
        "version": VERSION,
        "config": to_mapping(transitions.config),
        "obs_type": transitions.obs_type,
        "demos": transitions.demos,
        "failed": transitions.failed,
    }
    arrays: dict[str, NDArray[np.generic]] = {
        **{f"observation.{key}": part for key, part in transitions.observation.items()},
        **{f"next_observation.{key}": part for key, part in transitions.next_observation.items()},
        **{name: getattr(transitions, name) for name in _ARRAYS},
        "about": np.array(json.dumps(about)),
    }
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    write_bytes(path, content.getvalue())


_ARRAYS = ("action", "reward", "terminated", "truncated", "episode", "seeds")


def read_transitions(path: Path) -> Transitions:
    """Read what `write_transitions` wrote; no code in the file can run.

    Raises:
        BadFile: missing, damaged, or something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            about = checked(parse_json(str(file["about"]), str(path)), dict, str(path))
            if about.pop("version") != VERSION:
                raise BadFile(f"{path} is of another format version; export the demos again.")
            config = from_mapping(TaskConfig, about.pop("config"), str(path))
            fields: dict[str, Any] = {
                name: {
                    key.removeprefix(f"{name}."): file[key]
                    for key in file.files
                    if key.startswith(f"{name}.")
                }
                for name in ("observation", "next_observation")
            }
            fields |= {name: file[name] for name in _ARRAYS}
        return Transitions(config=config, **about, **fields)
    except DAMAGED as error:
        raise BadFile(f"{path} is not a file of transitions ({error}).") from None
