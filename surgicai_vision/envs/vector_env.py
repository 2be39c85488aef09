"""Vectorised: many envs in a few worker processes.

    gymnasium.make_vec("surgicai_vision/Insert-v0", 16, workers=2)

gymnasium's own `async` mode gives each env a process and a message per step; in state mode the
message costs as much as the step, so two workers are no faster than one. Here a worker steps its
share of the envs with a `SyncVectorEnv` and answers once for all of them; observations come back
through shared memory. Trajectories, infos and autoreset are those of `SyncVectorEnv`, whatever the
number of workers. `benchmarks/speed.py --only workers` measures the speed.
"""

import itertools
import traceback
from collections.abc import Mapping, Sequence
from copy import deepcopy
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, SurgicaiError, check_name
from surgicai_vision.core.processes import Child
from surgicai_vision.core.tasks import task_steps
from surgicai_vision.envs import SuturingEnv, make_task, refuse_max_steps
from surgicai_vision.envs.success import Info

Tree = Any
"""Arrays, or dicts of trees."""
Arguments = dict[str, Any]
"""Keyword arguments of `make_task`."""
Step = tuple[Tree, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]


def make_vector(
    num_envs: int = 1,
    workers: int = 0,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    max_episode_steps: int = 0,
    **arguments: Any,
) -> VectorEnv:
    """Return a vector env; the vector entry point of the gymnasium ids.

    Args:
        num_envs: number of envs.
        workers: worker processes, at most as many as envs; 0 steps all envs in this process.
        autoreset_mode: gymnasium's: "NextStep" (default), "SameStep" or "Disabled".
        max_episode_steps: limit of an episode [actions], as for `gymnasium.make`; 0 takes the
            paper's.
        **arguments: what `envs.make_task` takes, without `max_steps`.
    """
    refuse_max_steps(arguments)
    if not isinstance(autoreset_mode, AutoresetMode):
        check_name("autoreset mode", autoreset_mode, [mode.value for mode in AutoresetMode])
    # An env of another distribution ends its episodes itself, after so many control steps.
    own = task_steps(arguments["task"]) if arguments["task"] in names.TASKS else 0
    arguments["max_steps"] = (max_episode_steps or own) * arguments.get("action_repeat", 1)
    return vector_of(num_envs, workers, AutoresetMode(autoreset_mode), arguments)


def vector_of(num_envs: int, workers: int, mode: AutoresetMode, arguments: Arguments) -> VectorEnv:
    """Return a vector env of `make_task(**arguments)`; see `make_vector`."""
    if num_envs < 1 or workers < 0:
        raise InputError(
            f"num_envs is {num_envs}, workers is {workers}; allowed: at least 1, at least 0."
        )
    if workers:
        return SuturingVectorEnv(num_envs, min(workers, num_envs), mode, arguments)
    return SyncVectorEnv([lambda: _make(arguments)] * num_envs, autoreset_mode=mode)


class SuturingVectorEnv(VectorEnv):
    """Envs of one task in worker processes; see `make_vector` for the arguments.

    Processes are spawned, so a script that makes one needs the usual `if __name__ == "__main__":`.
    """

    def __init__(self, num_envs: int, workers: int, mode: AutoresetMode, arguments: Arguments):
        self._workers: list[Child] = []
        self.num_envs = num_envs
        first = _make(arguments)
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.metadata = dict(first.metadata) | {"autoreset_mode": mode}
        self.render_mode = first.render_mode
        first.close()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._memory = _reserve(self.observation_space)
        self._seen = _view(self.observation_space, self._memory)
        edges = [num_envs * index // workers for index in range(workers + 1)]
        self._shares = [slice(start, end) for start, end in itertools.pairwise(edges)]
        for share in self._shares:
            self._workers.append(
                Child(
                    _work,
                    share,
                    arguments,
                    mode,
                    self.observation_space,
                    self._memory,
                    variables={},
                )
            )
        self._ask_all("ready", [()] * workers)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, object] | None = None,
    ) -> tuple[Tree, Info]:
        """Reset all envs, or those of `options["reset_mask"]`.

        An int seeds them with seed, seed + 1, …
        """
        self._check_open()
        if isinstance(seed, list | tuple):
            seeds = list(seed)
        else:
            seeds = [None if seed is None else seed + index for index in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise InputError(
                f"seed holds {len(seeds)} seeds; this vector env has {self.num_envs} envs."
            )
        mask = self._checked_mask(options)
        chosen = []
        for share in self._shares:
            part = dict(options) if options else None
            if part is not None and mask is not None:
                part["reset_mask"] = mask[share]
            chosen.append((seeds[share], part))
        infos = self._ask_all("reset", chosen)
        return deepcopy(self._seen), self._merge(infos)

    def step(self, actions: NDArray[np.float32]) -> Step:
        """Step all envs; actions are (num_envs, 7)."""
        self._check_open()
        if np.shape(actions) != self.action_space.shape:
            raise InputError(
                f"actions has shape {np.shape(actions)}; this vector env needs "
                f"{self.action_space.shape}."
            )
        actions = np.asarray(actions)
        answers = self._ask_all("step", [(actions[share],) for share in self._shares])
        rewards, terminated, truncated = (
            np.concatenate([answer[index] for answer in answers]) for index in range(3)
        )
        infos = self._merge([answer[3] for answer in answers])
        return deepcopy(self._seen), rewards, terminated, truncated, infos

    def call(self, name: str, *args: object, **kwargs: object) -> tuple[object, ...]:
        """Return an attribute of each env, or what its method returns."""
        self._check_open()
        return tuple(
            value
            for part in self._ask_all("call", [(name, args, kwargs)] * len(self._shares))
            for value in part
        )

    def get_attr(self, name: str) -> tuple[object, ...]:
        """Return an attribute of each env."""
        return self.call(name)

    def set_attr(self, name: str, values: object) -> None:
        """Set an attribute of each env, to one value for all or to a list with one per env."""
        self._check_open()
        rows = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(rows) != self.num_envs:
            raise InputError(
                f"values holds {len(rows)} values; this vector env has {self.num_envs} envs."
            )
        self._ask_all("set_attr", [(name, rows[share]) for share in self._shares])

    def render(self) -> tuple[Any, ...]:
        """Return each env's image."""
        return self.call("render")

    def close_extras(self, **kwargs: object) -> None:
        """End the workers."""
        for worker in self._workers:
            worker.dismiss()
        self._workers = []

    def _checked_mask(self, options: Mapping[str, object] | None) -> NDArray[np.bool_] | None:
        """Return which envs a reset is for, (num_envs,), or None for all; refuse a wrong mask."""
        if options is None or "reset_mask" not in options:
            return None
        mask = np.asarray(options["reset_mask"])
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise InputError(
                f"options['reset_mask'] is {mask.dtype} of shape {mask.shape} with "
                f"{np.count_nonzero(mask)} chosen; it must be bool of shape ({self.num_envs},) "
                "with at least one."
            )
        return mask

    def _check_open(self) -> None:
        if self.closed or not self._workers:
            raise InputError("The vector env is closed; make a new one.")

    def _ask_all(self, what: str, arguments: Sequence[object]) -> list[Any]:
        """Send each worker its part, then collect the answers; one worker's error ends all."""
        try:
            for worker, part in zip(self._workers, arguments, strict=True):
                worker.connection.send((what, part))
            answers = [worker.connection.recv() for worker in self._workers]
        except (EOFError, OSError) as error:
            codes = [worker.exit_code for worker in self._workers]
            self.close()
            raise SurgicaiError(
                f"A worker of the vector env died (exit codes {codes}); make a new one."
            ) from error
        except BaseException:
            self.close()  # an answer may still be on its way: it is not that of the next request
            raise
        for answer in answers:
            if isinstance(answer, _Failure):
                self.close()
                raise answer.error from RuntimeError(answer.trace)
        return answers

    def _merge(self, infos: list[Info]) -> Info:
        """Return the workers' infos as one, in the envs' order."""
        return _merged(infos, [share.stop - share.start for share in self._shares])


class _Failure:
    """An error in a worker, with its traceback there."""

    def __init__(self, error: Exception):
        self.error = error
        self.trace = traceback.format_exc()


def _make(arguments: Arguments) -> SuturingEnv:
    return make_task(**arguments)


def _work(
    connection: Connection,
    share: slice,
    arguments: Arguments,
    mode: AutoresetMode,
    space: spaces.Space[object],
    memory: Tree,
) -> None:
    """Serve one share of the envs until the other end is closed."""
    vector = None
    seen = _view(space, memory)
    try:
        while True:
            what, part = connection.recv()
            try:
                if vector is None:
                    makers = [lambda: _make(arguments)] * (share.stop - share.start)
                    vector = SyncVectorEnv(makers, copy=False, autoreset_mode=mode)
                answer = _answer(vector, what, part, seen, share)
            except Exception as error:
                answer = _Failure(error)
            connection.send(answer)
    finally:
        if vector is not None:
            vector.close()


def _answer(vector: SyncVectorEnv, what: str, part: Any, seen: Tree, share: slice) -> object:
    """Handle a request; observations go to shared memory."""
    if what == "step":
        observation, *rest = vector.step(*part)
        _write(seen, share, observation)
        return rest
    if what == "reset":
        seeds, options = part
        if options is not None and "reset_mask" in options and not options["reset_mask"].any():
            return {}
        observation, info = vector.reset(seed=seeds, options=options)
        _write(seen, share, observation)
        return info
    if what == "call":
        name, args, kwargs = part
        return vector.call(name, *args, **kwargs)
    if what == "set_attr":
        vector.set_attr(*part)
    return None


# -- trees of arrays -------------------------------------------------------------------------------


def _reserve(space: spaces.Space[object]) -> Tree:
    """Return shared memory for a batched space."""
    if isinstance(space, spaces.Dict):
        return {key: _reserve(part) for key, part in space.spaces.items()}
    assert space.shape is not None and space.dtype is not None
    return RawArray("b", int(np.prod(space.shape)) * space.dtype.itemsize)


def _view(space: spaces.Space[object], memory: Tree) -> Tree:
    """Return the arrays that lie in shared memory."""
    if isinstance(space, spaces.Dict):
        return {key: _view(part, memory[key]) for key, part in space.spaces.items()}
    return np.frombuffer(memory, dtype=space.dtype).reshape(space.shape)


def _write(seen: Tree, share: slice, observation: Tree) -> None:
    if isinstance(seen, dict):
        for key, part in seen.items():
            _write(part, share, observation[key])
    else:
        seen[share] = observation


def _merged(parts: list[Info], sizes: list[int]) -> Info:
    """Return dicts of arrays as one, rows of absent keys filled as gymnasium does."""
    if len(parts) == 1:
        return parts[0]
    merged: Info = {}
    for key in dict.fromkeys(itertools.chain.from_iterable(parts)):
        values: list[Any] = [part.get(key) for part in parts]
        known = next(value for value in values if value is not None)
        if isinstance(known, dict):
            merged[key] = _merged([value or {} for value in values], sizes)
            continue
        if any(value is None for value in values):
            empty = None if known.dtype == object else 0
            values = [
                np.full((size, *known.shape[1:]), empty, known.dtype) if value is None else value
                for value, size in zip(values, sizes, strict=True)
            ]
        merged[key] = np.concatenate(values)
    return merged
