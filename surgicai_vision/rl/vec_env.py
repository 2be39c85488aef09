"""Our envs as a vector env of Stable-Baselines3, in this process or in a few workers.

    envs = SuturingVecEnv("grasp", 16, workers=2, obs_type="goal")
    model = SAC("MultiInputPolicy", envs, replay_buffer_class=HerReplayBuffer, …)

It adapts `envs.vector_env`: trajectories are the same with any number of workers. Infos hold what
Stable-Baselines3 reads: `terminal_observation`, `TimeLimit.truncated`, and the return, length and
success of an ended episode. `compute_reward` and `compute_terminated`, which hindsight relabelling
calls for each batch, run in this process.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any, cast, final

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import OPTIONS, make_task
from surgicai_vision.envs.success import Info
from surgicai_vision.envs.vector_env import vector_of

LOCAL = ("compute_reward", "compute_terminated")
"""Methods that are functions of goals alone."""
type Snapshot = tuple[NDArray[np.float64], dict[str, object]]


@final
class SuturingVecEnv(VecEnv):
    """Envs of one task; see the module's docstring.

    Args:
        task: one of `tasks.task_names()`.
        n_envs: number of envs.
        workers: worker processes; 0 steps all envs in this one. Processes are spawned, so a script
            needs the usual `if __name__ == "__main__":`.
        **arguments: what `envs.make_task` takes; `max_steps` limits an episode [control steps].

    Attributes:
        actions: the last actions given, (n_envs, 7).
    """

    def __init__(self, task: str, n_envs: int = 1, workers: int = 0, **arguments: Any):
        limit = arguments.pop("max_steps", 0)
        self._arguments = {"task": task, "max_steps": limit, **arguments}
        # a vector env of gymnasium declares neither `call` nor lists of seeds
        self._vector: Any = vector_of(n_envs, workers, AutoresetMode.SAME_STEP, self._arguments)
        self._local = make_task(**self._arguments)
        self.actions: NDArray[np.float32] = np.zeros((n_envs, 7), np.float32)
        self._returns: NDArray[np.float64] = np.zeros(n_envs)
        self._lengths: NDArray[np.int64] = np.zeros(n_envs, np.int64)
        self._began = time.monotonic()
        observed = self._vector.single_observation_space
        super().__init__(n_envs, observed, self._vector.single_action_space)

    @classmethod
    def of(
        cls, config: TaskConfig, obs_type: str, n_envs: int = 1, workers: int = 0
    ) -> "SuturingVecEnv":
        """Return the envs of a configuration."""
        fields = {name: getattr(config, name) for name in OPTIONS}
        return cls(
            config.task,
            n_envs,
            workers,
            obs_type=obs_type,
            scene=config.scene,
            randomisation=config.randomisation,
            **fields,
        )

    # -- stepping ----------------------------------------------------------------------------------

    def reset(self) -> VecEnvObs:
        """Reset all envs; seeds set by `seed` and options set by `set_options` are used only once.

        Raises:
            InputError: options that differ between envs; the vector env takes one table for all.
        """
        options = self._options[0] or None
        if any((other or None) != options for other in self._options):
            raise InputError("set_options sets the options of all envs; give one table for all.")
        observation, info = self._vector.reset(seed=list(self._seeds), options=options)
        self.reset_infos = _rows(info, self.num_envs)
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self._reset_seeds()
        self._reset_options()
        return cast(VecEnvObs, observation)

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions (n_envs, 7) for `step_wait`."""
        self.actions = np.asarray(actions, np.float32)

    def step_wait(self) -> VecEnvStepReturn:
        """Take a step in every env; those that end are reset at once."""
        observation, rewards, terminated, truncated, info = self._vector.step(self.actions)
        final_observations = info.pop("final_obs", None)
        final_info = info.pop("final_info", None)
        info.pop("_final_obs", None)
        info.pop("_final_info", None)
        infos = _rows(info, self.num_envs)
        ended = np.asarray(terminated | truncated)
        self._returns += rewards
        self._lengths += 1
        finals = _rows(final_info, self.num_envs) if final_info is not None else infos
        for index in np.flatnonzero(ended).tolist():
            self.reset_infos[index] = infos[index]
            infos[index] = finals[index]
            infos[index]["terminal_observation"] = final_observations[index]
            infos[index]["episode"] = {
                "r": float(self._returns[index]),
                "l": int(self._lengths[index]),
                "t": round(time.monotonic() - self._began, 6),
            }
            self._returns[index] = 0.0
            self._lengths[index] = 0
        for index, row in enumerate(infos):
            row["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
        rewards = np.asarray(rewards, np.float32)
        return cast(VecEnvObs, observation), rewards, ended, infos

    def close(self) -> None:
        """End the workers."""
        self._vector.close()
        self._local.close()

    # -- the complete state ------------------------------------------------------------------------

    def get_state(self) -> tuple[list[Snapshot], NDArray[np.float64], NDArray[np.int64]]:
        """Return everything the next step depends on: envs, returns and lengths so far."""
        snapshots = cast(list[Snapshot], self.get_attr("snapshot"))
        return snapshots, self._returns.copy(), self._lengths.copy()

    def set_state(
        self,
        snapshots: Sequence[Snapshot],
        returns: NDArray[np.float64],
        lengths: NDArray[np.int64],
    ) -> None:
        """Restore what `get_state` returned."""
        if len(snapshots) != self.num_envs:
            raise InputError(f"There are {len(snapshots)} states for {self.num_envs} envs.")
        self._vector.reset()
        self._vector.set_attr("snapshot", list(snapshots))
        self._returns = np.array(returns, np.float64)
        self._lengths = np.array(lengths, np.int64)

    # -- attributes --------------------------------------------------------------------------------

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each env."""
        values = self._vector.get_attr(attr_name)
        return [values[index] for index in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all envs, and of the one that represents them in this process."""
        if len(list(self._chosen(indices))) != self.num_envs:
            raise InputError("set_attr sets an attribute of all envs; leave indices out.")
        self._vector.set_attr(attr_name, [value] * self.num_envs)
        setattr(self._local, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Return what a method of each env returns."""
        chosen = list(self._chosen(indices))
        if method_name in LOCAL:
            answer = getattr(self._local, method_name)(*method_args, **method_kwargs)
            return [answer] * len(chosen)
        values = self._vector.call(method_name, *method_args, **method_kwargs)
        return [values[index] for index in chosen]

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each env: they report their episodes without a wrapper."""
        return [False for _ in self._chosen(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return each env's image in render mode "rgb_array"."""
        return cast(Sequence[NDArray[np.uint8] | None], self._vector.call("render"))

    def _chosen(self, indices: VecEnvIndices) -> Iterable[int]:
        return self._get_indices(indices)


def _rows(info: Info, count: int) -> list[dict[str, Any]]:
    """Return a vector env's info as one dict for each env."""
    rows: list[dict[str, Any]] = [{} for _ in range(count)]
    for key, values in info.items():
        if key.startswith("_"):
            continue
        present = info.get(f"_{key}", np.ones(count, bool))
        parts = _rows(values, count) if isinstance(values, dict) else values
        for index in np.flatnonzero(present).tolist():
            rows[index][key] = parts[index]
    return rows
