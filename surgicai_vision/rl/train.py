"""Train by reinforcement or offline learning: from a request to a checkpoint.

`train(request, demos, out)` resumes an interrupted training: a kill loses at most the steps since
the last training state, and the result is the same as without it. See the package's docstring for
the folder.

The policy kept is that of the evaluation with the most successes from validation starts; among
equals, the last. Success fluctuates during learning, and where it happens to end says little.
Without `validation` the last policy is kept. With the setting `stop_at` learning ends early, once
the task is solved.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from policies.actor import VECTORS, ActorRecipe
from policies.base import Policy
from surgicai_vision import __version__, envs
from surgicai_vision.core import names, processes
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import write_json
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.core.words import plural
from surgicai_vision.envs.relative import relative_features
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.rollout import run_share
from surgicai_vision.rl.extra import check_extra
from surgicai_vision.rl.learner import Diverged, Learner
from surgicai_vision.rl.settings import STOP_AFTER, Request, read_by
from surgicai_vision.rl.transitions import Transitions, of_demos
from surgicai_vision.scene.kinematics import base_in_world
from surgicai_vision.training.checkpoint import Checkpoint, write_checkpoint
from surgicai_vision.training.folder import (
    finished_training,
    read_state,
    training_in,
    write_state,
)
from surgicai_vision.training.policies import policy_plugin
from surgicai_vision.training.run_config import RunConfig
from surgicai_vision.training.threads import one_thread

CURVE = "curve.json"
IMAGE_SIZE = 224
"""Recorded in a checkpoint without images; nothing reads it."""
SMALLEST_STD = 0.1
"""Inputs that vary less (cm, rad or a share) are divided by this: exploration leaves the narrow
path of the demonstrations, and would otherwise see inputs of many standard deviations."""
CONSTANT_STD = 1e-6
"""Inputs that vary less count as constant and are divided by 1: the goals of demonstrations require
contact or holes; relabelled goals mostly do not, and would otherwise lie ten deviations away."""
RANDOM_EPISODES = 5
"""Episodes of random actions that give the input statistics if there are no demonstrations."""
EVALUATED_AT_ONCE = 10
NOT_A_DISTRIBUTION = "Expected parameter "
"""How torch's error begins for a distribution with a mean of NaN or a deviation of 0."""
Weights = Mapping[str, torch.Tensor]
"""Names → parameters of an actor."""
Note = Callable[[str], None]
"""Tells the user something in one line."""


def untold(text: str) -> None:
    """Drop a note."""


@dataclass(frozen=True)
class Point:
    """One point of a learning curve.

    Attributes:
        env_steps: control steps taken in the env so far.
        updates: updates of the weights so far.
        minutes: CPU time of learning so far in this process, without evaluations and without the
            worker processes of envs.
        successes: episodes that succeeded.
        episodes: episodes evaluated, from validation starts.
        distance_mm: median distance to the goal at their end.
    """

    env_steps: int
    updates: int
    minutes: float
    successes: int
    episodes: int
    distance_mm: float


def train(
    request: Request,
    demos: Sequence[Path],
    out: Path,
    *,
    workers: int = 0,
    progress: Progress | None = None,
    note: Note = untold,
    tensorboard: bool = True,
) -> Checkpoint:
    """Train, or resume an interrupted training, and write the checkpoint.

    Args:
        request: what is trained.
        demos: files of the demonstrations; empty for an algorithm that uses none.
        out: the checkpoint folder; new, or one of the same request.
        workers: worker processes that step the envs; they change no result.
        progress: called with (control steps or updates done, in total).
        note: called with a line on demonstrations that are left out.
        tensorboard: write curves to `<out>-tensorboard`.

    Raises:
        InputError: the extra is not installed, demonstrations of another env, or an actor that
            diverges.
        OutputExists: `out` holds something else.
    """
    check_extra(f"--algo {request.algo}", *_packages(request))
    wanted = {"algo": request.algo, "code_version": __version__, "request": to_mapping(request)}
    if (done := finished_training(out, wanted)) is not None:
        return done
    transitions = None
    if request.algorithm.needs_demos:
        transitions = _replayed(request, demos, note)  # refuses them before the folder is begun
    with training_in(out, wanted) as done, torch.random.fork_rng(devices=[]), one_thread():
        if done is not None:
            return done
        learner = _learner(request, transitions, workers)
        try:
            return _run(request, learner, out, progress, tensorboard)
        finally:
            learner.close()


def train_seeds(
    requests: Sequence[Request],
    demos: Sequence[Path],
    outs: Sequence[Path],
    *,
    workers: int = 0,
    progress: Progress | None = None,
    note: Note = untold,
    tensorboard: bool = True,
) -> None:
    """Train several requests in parallel, in `workers` processes; see `train`.

    A single one is trained in this process, and the workers step its envs.
    """
    jobs = list(zip(requests, outs, strict=True))
    if len(jobs) == 1 or not workers:
        for request, out in jobs:
            train(
                *(request, demos, out),
                workers=workers,
                progress=progress,
                note=note,
                tensorboard=tensorboard,
            )
        return
    total = sum(request.total for request in requests)
    done = 0
    for start in range(0, len(jobs), workers):
        batch = jobs[start : start + workers]
        calls = [
            functools.partial(_train_reporting, request, list(demos), out, tensorboard)
            for request, out in batch
        ]
        hear = functools.partial(_show, progress or silent, done, total)
        for notes in processes.run_all(calls, "the training", hear):
            for text in notes:
                note(text)
        done += sum(request.total for request, _ in batch)


def _train_reporting(
    request: Request,
    demos: Sequence[Path],
    out: Path,
    tensorboard: bool,
    report: Callable[[int], None],
) -> list[str]:
    """Train in a worker process, reporting the steps done; return the notes."""
    notes: list[str] = []

    def show(done: int, total: int, unit: str = "", /) -> None:
        report(done)

    train(request, demos, out, progress=show, note=notes.append, tensorboard=tensorboard)
    return notes


def _show(progress: Progress, before: int, total: int, steps: Sequence[int]) -> None:
    """Show what the worker processes reported."""
    progress(before + sum(steps), total)


def _packages(request: Request) -> tuple[str, ...]:
    """Return the packages that are needed: Stable-Baselines3 logs the curves in any case."""
    return ("stable_baselines3", request.algorithm.library)


def _replayed(request: Request, demos: Sequence[Path], note: Note) -> Transitions:
    """Return the demonstrations as the request learns from them; note how many are left out."""
    obs_type = "goal" if request.algorithm.has_hindsight else request.observation
    rule = request.settings.success_rule
    transitions = of_demos(demos, request.env, obs_type, success_rule=rule)
    if transitions.failed:
        note(
            f"{transitions.failed} of {plural(len(demos), 'demonstration')} did not succeed when "
            f"replayed with these options; '{request.algo}' learns from the others."
        )
    return transitions


def _learner(request: Request, transitions: Transitions | None, workers: int) -> Learner:
    """Return the untrained learner of a request."""
    algorithm = request.algorithm
    mean, std = _statistics(request, transitions)
    if algorithm.is_online:
        from surgicai_vision.rl.online import OnlineLearner

        return OnlineLearner(request, transitions, mean, std, workers)
    from surgicai_vision.rl.offline import OfflineLearner

    assert transitions is not None
    return OfflineLearner(request, transitions, mean, std)


def _statistics(
    request: Request, transitions: Transitions | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and standard deviation of inputs: of demonstrations, else of random actions."""
    if transitions is None:
        rows = _random_play(request)
    elif transitions.is_goal:
        seen = transitions.observation
        rows = relative_features(
            seen["observation"],
            seen["achieved_goal"],
            seen["desired_goal"],
            base_in_world(names.ACTIVE_ARM[request.env.task])[:3, :3],
        )
    else:
        rows = transitions.vector
    values = rows.astype(np.float64)
    spread = values.std(axis=0)
    std = np.where(spread < CONSTANT_STD, 1.0, np.maximum(spread, SMALLEST_STD))
    return values.mean(axis=0), std


def _random_play(request: Request) -> NDArray[np.float32]:
    """Return the observations in episodes of random actions, (n, inputs)."""
    env = envs.make(request.env, request.observation)
    rng = np.random.default_rng(request.seed)
    rows = []
    for episode in range(RANDOM_EPISODES):
        seen, _ = env.reset(seed=names.TRAIN_SEED + episode)
        ended = False
        while not ended:
            rows.append(seen)
            action = rng.uniform(-1.0, 1.0, 7).astype(np.float32)
            seen, _, terminated, truncated, _ = env.step(action)
            ended = terminated or truncated
    env.close()
    return np.stack([np.asarray(row) for row in rows])


def _run(
    request: Request,
    learner: Learner,
    out: Path,
    progress: Progress | None,
    tensorboard: bool,
) -> Checkpoint:
    """Learn to the end, with periodic evaluations and training states."""
    curve, best = _resume(learner, out)
    log = _Log(out if tensorboard else None, learner)
    minutes = curve[-1].minutes if curve else 0.0
    if progress:
        progress(min(learner.done, request.total), request.total)
    is_over = _is_over(request, learner, curve)
    while not is_over:
        target = min((learner.done // request.save_every + 1) * request.save_every, request.total)
        began = time.process_time()
        losses = _advance(request, learner, target)
        minutes += (time.process_time() - began) / 60.0
        actor = actor_of(request, learner)
        curve.append(_evaluate(request, actor, learner, minutes))
        if curve[-1] == best_point(curve):
            best = actor.state_dict()
        log.draw(curve[-1], losses)
        write_json(out / CURVE, [dataclasses.asdict(point) for point in curve])
        is_over = _is_over(request, learner, curve)
        if not is_over:
            _save(learner, curve, best, out)
        if progress:
            progress(request.total if is_over else learner.done, request.total)
    log.close()
    return _write(request, best, learner.squash, best_point(curve), out)


def _advance(request: Request, learner: Learner, target: int) -> dict[str, float]:
    """Learn until `target`; return the last losses by name.

    Raises:
        InputError: the actor has diverged.
    """
    try:
        return learner.advance(target)
    except Diverged as error:
        raise _diverged(request, "its actions are") from error
    except ValueError as error:
        if not str(error).startswith(NOT_A_DISTRIBUTION):
            raise
        raise _diverged(request, "its distribution of actions is") from error


def _diverged(request: Request, what: str) -> InputError:
    """Return the error for a training whose actor diverged."""
    return InputError(f"'{request.algo}' diverged: {what} not finite; lower the learning rate.")


def _is_over(request: Request, learner: Learner, curve: Sequence[Point]) -> bool:
    """Return True after the last step, or once the last evaluations have reached `stop_at`."""
    if learner.done >= request.total:
        return True
    share = request.settings.stop_at
    last = curve[-STOP_AFTER:]
    solved = [point.successes >= share * point.episodes for point in last]
    return share > 0 and len(solved) == STOP_AFTER and all(solved)


class CurvePoint(Protocol):
    """A point of some learning curve, a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    @property
    def successes(self) -> int:
        """Episodes that succeeded."""

    @property
    def minutes(self) -> float:
        """CPU time of learning so far."""


def best_point[P: CurvePoint](curve: Sequence[P]) -> P:
    """Return the point whose policy is kept: the most successes; among equals, the last."""
    return max(reversed(curve), key=lambda point: point.successes)


def _save(learner: Learner, curve: Sequence[Point], best: Weights, out: Path) -> None:
    """Write the training state, atomically."""
    points = [dataclasses.asdict(point) for point in curve]
    state = {"learner": learner.get_state(), "curve": points, "best": dict(best)}
    write_state(out, state)


def _resume(learner: Learner, out: Path) -> tuple[list[Point], Weights]:
    """Resume from the training state, if it is complete; return the curve and the best weights."""
    state = read_state(out)
    if state is None:
        return [], {}
    learner.set_state(state["learner"])
    return [Point(**point) for point in state["curve"]], state["best"]


class _Log:
    """Writes curves for TensorBoard with Stable-Baselines3's logger, if there is a folder."""

    def __init__(self, out: Path | None, learner: Learner):
        self._logger: Any = None
        if out is None:
            return
        from stable_baselines3.common.logger import configure

        folder = out.with_name(f"{out.name}-tensorboard")
        self._logger = configure(str(folder), ["tensorboard"])
        if hasattr(learner, "log_to"):
            learner.log_to(self._logger)

    def draw(self, point: Point, losses: dict[str, float]) -> None:
        """Add a point of the curve and losses by name."""
        if self._logger is None:
            return
        step = point.env_steps or point.updates
        if point.episodes:
            self._logger.record("eval/success_rate", point.successes / point.episodes)
            self._logger.record("eval/distance_mm", point.distance_mm)
        for name, value in losses.items():
            self._logger.record(f"train/{name.replace(' ', '_')}", value)
        self._logger.dump(step)

    def close(self) -> None:
        """Write what is left."""
        if self._logger is not None:
            self._logger.close()


# -- the policy ------------------------------------------------------------------------------------


def actor_recipe(request: Request, squash: str) -> ActorRecipe:
    """Return the recipe that a checkpoint records of its actor."""
    return ActorRecipe(
        hidden=request.settings.hidden,
        learning_rate=request.settings.learning_rate,
        batch_size=request.settings.batch_size,
        validation=0.0,
        privileged=request.observation == "state",
        observation=request.observation,
        squash=squash,
        algo=request.algo,
        settings=read_by(request.algorithm, request.settings),
    )


def actor_of(request: Request, learner: Learner) -> Policy:
    """Return the learner's actor as one of our policies."""
    actor = policy_plugin(request.algorithm.policy).make(actor_recipe(request, learner.squash), ())
    learner.fill(actor)
    actor.eval().requires_grad_(False)
    return actor


def _evaluate(request: Request, actor: Policy, learner: Learner, minutes: float) -> Point:
    """Measure successes from validation starts, leaving the generators unchanged."""
    steps = learner.done if request.algorithm.is_online else 0
    if not request.validation:
        return Point(steps, learner.updates, minutes, 0, 0, 0.0)
    make = functools.partial(
        PolicyAgent,
        request.algo,
        actor,
        None,
        (),
        IMAGE_SIZE,
        (VECTORS[request.observation],),
    )
    seeds = range(names.VALIDATION_SEED, names.VALIDATION_SEED + request.validation)
    episodes = run_share(make, request.env, seeds, EVALUATED_AT_ONCE, report=lambda _: None)
    rows = [episode.row for episode in episodes]
    return Point(
        env_steps=steps,
        updates=learner.updates,
        minutes=minutes,
        successes=sum(row.success for row in rows),
        episodes=len(rows),
        distance_mm=float(np.median([row.d_trans_mm for row in rows])),
    )


def run_of(request: Request) -> RunConfig:
    """Return the run that a request describes."""
    return RunConfig(
        env=request.env,
        policy=request.algorithm.policy,
        privileged=request.observation == "state",
        recipe="rl",
        changes=request.changes,
        demonstrations=request.demonstrations or None,
        updates=request.updates or None,
        seed=request.seed,
        algo=request.algo,
        env_steps=request.env_steps,
    )


def _write(request: Request, weights: Weights, squash: str, kept: Point, out: Path) -> Checkpoint:
    """Write the actor with these weights, which are those of the point kept."""
    if not all(torch.isfinite(weight).all() for weight in weights.values()):
        raise _diverged(request, "weights are")
    recipe = actor_recipe(request, squash)
    checkpoint = Checkpoint(
        run=run_of(request),
        recipe=to_mapping(recipe),
        image_size=IMAGE_SIZE,
        encoder=None,
        proprioception=False,
        epoch=0,
        dataset=request.demos,
        frames=kept.env_steps or kept.updates,
        validation_episodes=(),
        train_losses=(),
        validation_losses=(),
        device="cpu",
        code_version=__version__,
    )
    return write_checkpoint(out, checkpoint, weights)
