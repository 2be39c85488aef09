"""PPO as high-level policy over fixed low-level ones: the hierarchy of SurgicAI's Table 3.

`DecisionEnv` is the whole procedure with one decision per step. A subtask is chosen, and its policy
moves its arm until the subtask's measured success has held or its steps are used up
(`evaluation.hierarchical`, `termination: privileged`). Then the next is chosen. The observation is
what a robot measures: pose and jaw of both arms, (14,). The reward is 1 for a decision that solved
the subtask that was due. Any other decision gives 0 and ends the episode: from where it leaves the
arms, hardly any decision is right, and the subtask that is due would rarely be solved. The paper
does not state its reward.

    train_high_level(HighLevelRequest(HierarchicalConfig(hlp="order", grasp="outputs/train/…", …,
                                      termination="privileged")), out)

writes a checkpoint of the policy `hlp`, for the key `hlp:` of a hierarchical policy's file. New
episodes begin after every training state, whether or not the training was killed, so that the same
command gives the same result. The folder and the choice of the policy to keep are as in `rl.train`.
"""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, final

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from torch import nn

from policies.base import Policy, Recipe
from surgicai_vision import __version__
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import PhysicsError
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.envs.suture import Suture
from surgicai_vision.evaluation.agent import Agent, MakeAgent
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.hierarchical import (
    HierarchicalAgent,
    common_images,
    leave_held_grasp,
)
from surgicai_vision.evaluation.hierarchical_config import HLP, HierarchicalConfig
from surgicai_vision.evaluation.policy_spec import hierarchical_policy, open_policy
from surgicai_vision.evaluation.rollout import run_share
from surgicai_vision.evaluation.slot import env_showing
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource
from surgicai_vision.rl.extractor import StandardExtractor
from surgicai_vision.rl.high_level_config import HighLevelRequest
from surgicai_vision.rl.learner import linear, random_state, set_random_state
from surgicai_vision.rl.stages import Stages
from surgicai_vision.rl.train import EVALUATED_AT_ONCE, IMAGE_SIZE, Weights
from surgicai_vision.training.checkpoint import Checkpoint, write_checkpoint
from surgicai_vision.training.folder import read_state, training_in, write_state
from surgicai_vision.training.policies import policy_plugin
from surgicai_vision.training.run_config import RunConfig
from surgicai_vision.training.threads import one_thread

ALGO = "ppo"
SMALLEST_STD = 1e-3
"""Inputs that vary less [m, rad] are divided by this."""
PLAYED_EPISODES = 2
"""Episodes played in the subtasks' order to get the statistics of the inputs."""

Vector = NDArray[np.float32]


@dataclass(frozen=True)
class Point:
    """One point of the learning curve.

    Attributes:
        decisions: decisions so far.
        env_steps: control steps so far.
        minutes: CPU time of learning so far, evaluations left out.
        successes: whole procedures that succeeded.
        episodes: whole procedures evaluated, from validation starts.
        stages: mean number of subtasks solved in them.
    """

    decisions: int
    env_steps: int
    minutes: float
    successes: int
    episodes: int
    stages: float


@final
class DecisionEnv(gymnasium.Env[Vector, np.int64]):
    """The whole procedure, with one decision per step; see the module's docstring.

    Args:
        config: limits on the steps of a subtask and the decisions of an episode.
        task: the whole procedure's config.
        low: the low-level policies' agents, in the order of the subtasks.

    Raises:
        InputError: agents that cannot act in one env (`common_images`).
    """

    def __init__(self, config: HierarchicalConfig, task: TaskConfig, low: Sequence[Agent]):
        self.config = config
        self._low = list(low)
        cameras, image_size, depth = common_images(self._low)
        self._env = cast(Suture, env_showing(task, cameras, image_size, depth=depth))
        self._observation: Any = None
        self._decisions = 0
        self.control_steps = 0
        size = len(names.BOTH_ARMS_NAMES)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(len(names.SUBTASKS))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Begin a procedure; return the measured poses (14,)."""
        super().reset(seed=seed)
        start = int(self.np_random.integers(names.VALIDATION_SEED))
        self._observation, _ = self._env.reset(seed=start)
        self._decisions = 0
        for agent in self._low:
            agent.reset(0, self._env, start)
        return self._env.both_arms(), {}

    def step(self, action: np.int64) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Let the policy of subtask `action` act until the subtask ends."""
        subtask = int(action)
        env = self._env
        agent = self._low[subtask]
        self._decisions += 1
        due = env.simulation.task_state.done
        agent.restart(0)
        env.enter(subtask)
        terminated = truncated = False
        info: dict[str, Any] = {}
        repeat = env.config.action_repeat
        for _ in range(-(-self.config.steps // repeat)):
            move = agent.act([0], [env], [self._observation])[0]
            if not np.isfinite(move).all():
                truncated = True
                break
            try:
                self._observation, _, terminated, truncated, info = env.step(move)
            except PhysicsError:
                truncated = True
                break
            self.control_steps += repeat
            if terminated or truncated:
                break
            leave_held_grasp(env, subtask, self.config.grasp_hold)
            if env.phase != subtask:
                break
        success = bool(info.get("is_success", False))
        solved = success or env.simulation.task_state.done > due
        terminated = terminated or not solved
        truncated = truncated or self._decisions >= self.config.decisions
        about = {"is_success": success, "progress": env.simulation.task_state.done}
        return env.both_arms(), float(solved), terminated, truncated, about

    @property
    def phase(self) -> int:
        """The present subtask, an index in `names.SUBTASKS`."""
        return self._env.phase

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()


def train_high_level(
    request: HighLevelRequest,
    out: Path,
    *,
    weights: WeightsSource = ANYWHERE,
    progress: Progress | None = None,
) -> Checkpoint:
    """Train PPO over low-level policies, or resume an interrupted training.

    Args:
        request: what is trained.
        out: the checkpoint folder; new, or one of the same request.
        weights: where pretrained weights come from.
        progress: called with (decisions done, decisions in total).

    Raises:
        BadFile: a low-level policy that is not a checkpoint.
        InputError: policies of other subtasks, of different scenes or of images of several sizes.
        MissingWeights: an encoder's weights are not at hand.
        OutputExists: `out` holds something else.
    """
    spec = hierarchical_policy(request.low, weights=weights)
    low = [open_policy(path, task=task, weights=weights) for task, path in request.low.low.items()]
    agents = [one.make_agent() for one in low]
    common_images(agents)  # refuses images of several sizes before the folder is begun
    acting = [one.about.get("checkpoint") or one.name for one in low]
    wanted = {"code_version": __version__, "request": to_mapping(request), "low": acting}
    with training_in(out, wanted) as done, torch.random.fork_rng(devices=[]), one_thread():
        if done is not None:
            return done
        env = DecisionEnv(request.low, spec.config, agents)
        try:
            make_low = [one.make_agent for one in low]
            return _run(request, spec.config, make_low, env, out, progress or silent)
        finally:
            env.close()


def _run(
    request: HighLevelRequest,
    task: TaskConfig,
    low: Sequence[MakeAgent],
    env: DecisionEnv,
    out: Path,
    progress: Progress,
) -> Checkpoint:
    """Learn to the end, with periodic evaluations and training states."""
    mean, std = _statistics(env)
    env.control_steps = 0
    model = _model(request, env, mean, std)

    def evaluate(minutes: float) -> tuple[Point, Weights]:
        policy = _policy(request, model)
        point = _evaluate(request, task, low, policy, model.num_timesteps, env, minutes)
        return point, policy.state_dict()

    stages = Stages(request.decisions, request.save_every, request.seed, out, progress)
    save = functools.partial(_save, model, env, out)
    best, kept = stages.run(model, _resume(model, env, out), evaluate, save)
    return _write(request, task, best, kept, env, out)


def _model(
    request: HighLevelRequest, env: DecisionEnv, mean: Sequence[float], std: Sequence[float]
) -> PPO:
    """Return the untrained model."""
    settings = request.settings
    hidden = list(settings.hidden)
    return PPO(
        "MlpPolicy",
        env,
        learning_rate=settings.learning_rate,
        gamma=settings.gamma,
        n_steps=settings.rollout,
        batch_size=settings.batch_size,
        n_epochs=settings.epochs,
        ent_coef=settings.entropy,
        seed=request.seed,
        device="cpu",
        policy_kwargs={
            "activation_fn": nn.ReLU,
            "net_arch": {"pi": hidden, "vf": hidden},
            "features_extractor_class": StandardExtractor,
            "features_extractor_kwargs": {"mean": list(mean), "std": list(std)},
        },
    )


def _statistics(env: DecisionEnv) -> tuple[list[float], list[float]]:
    """Return mean and standard deviation of the observations in procedures in subtask order."""
    rows = []
    for episode in range(PLAYED_EPISODES):
        seen, _ = env.reset(seed=names.TRAIN_SEED + episode)
        rows.append(seen)
        for _ in range(2 * len(names.SUBTASKS)):
            seen, _, terminated, truncated, _ = env.step(np.int64(env.phase))
            rows.append(seen)
            if terminated or truncated:
                break
    values = np.stack(rows).astype(np.float64)
    return values.mean(axis=0).tolist(), np.maximum(values.std(axis=0), SMALLEST_STD).tolist()


# -- the state -------------------------------------------------------------------------------------


def _save(model: PPO, env: DecisionEnv, out: Path, curve: Sequence[Point], best: Weights) -> None:
    """Write the training state, atomically."""
    state = {
        "parameters": model.get_parameters(),
        "decisions": model.num_timesteps,
        "updates": model._n_updates,
        "control_steps": env.control_steps,
        "random": random_state(),
        "curve": [dataclasses.asdict(point) for point in curve],
        "best": dict(best),
    }
    write_state(out, state)


def _resume(model: PPO, env: DecisionEnv, out: Path) -> tuple[list[Point], Weights]:
    """Resume from the training state, if it is complete; return the curve and the best weights."""
    state = read_state(out)
    if state is None:
        return [], {}
    model.set_parameters(state["parameters"], exact_match=True)
    model.num_timesteps = state["decisions"]
    model._n_updates = state["updates"]
    env.control_steps = state["control_steps"]
    set_random_state(state["random"])
    return [Point(**point) for point in state["curve"]], state["best"]


# -- the policy ------------------------------------------------------------------------------------


def _recipe(request: HighLevelRequest) -> Recipe:
    """Return the recipe that a checkpoint records of its network and training."""
    return policy_plugin(HLP).recipe(
        hidden=request.settings.hidden,
        batch_norm=False,
        learning_rate=request.settings.learning_rate,
        batch_size=request.settings.batch_size,
        validation=0.0,
    )


@torch.no_grad()
def _policy(request: HighLevelRequest, model: PPO) -> Policy:
    """Return the actor as a policy `hlp`."""
    policy = policy_plugin(HLP).make(_recipe(request), ())
    actor = [*linear(model.policy.mlp_extractor.policy_net), *linear(model.policy.action_net)]
    for own, given in zip(linear(policy), actor, strict=True):
        own.weight.copy_(given.weight)
        own.bias.copy_(given.bias)
    extractor = cast(StandardExtractor, model.policy.features_extractor)
    policy.input_mean.copy_(extractor.mean)
    policy.input_std.copy_(extractor.std)
    return policy.eval().requires_grad_(False)


def _evaluate(
    request: HighLevelRequest,
    task: TaskConfig,
    low: Sequence[MakeAgent],
    policy: Policy,
    decisions: int,
    env: DecisionEnv,
    minutes: float,
) -> Point:
    """Evaluate whole procedures from validation starts, in the way a checkpoint is evaluated."""
    successes = 0
    stages = 0.0
    if request.validation:
        high = functools.partial(PolicyAgent, HLP, policy, None, (), IMAGE_SIZE, (names.BOTH_ARMS,))
        make = functools.partial(
            HierarchicalAgent, request.low, low, high, action_repeat=task.action_repeat
        )
        seeds = range(names.VALIDATION_SEED, names.VALIDATION_SEED + request.validation)
        episodes = run_share(make, task, seeds, EVALUATED_AT_ONCE, report=lambda _: None)
        successes = sum(episode.row.success for episode in episodes)
        stages = float(np.mean([episode.row.stages for episode in episodes]))
    return Point(
        decisions=decisions,
        env_steps=env.control_steps,
        minutes=minutes,
        successes=successes,
        episodes=request.validation,
        stages=stages,
    )


def run_of(request: HighLevelRequest, task: TaskConfig, env_steps: int | None = None) -> RunConfig:
    """Return the run that a request describes.

    Args:
        request: what is trained.
        task: any task of the procedure's scene.
        env_steps: control steps taken; None before training.
    """
    return RunConfig(
        env=dataclasses.replace(task, task=names.SUTURE, max_steps=0, advance="success"),
        policy=HLP,
        recipe="rl",
        updates=request.decisions,
        seed=request.seed,
        algo=ALGO,
        env_steps=env_steps,
    )


def _write(
    request: HighLevelRequest,
    task: TaskConfig,
    weights: Weights,
    kept: Point,
    env: DecisionEnv,
    out: Path,
) -> Checkpoint:
    """Write the high-level policy with these weights, which are those of the point kept."""
    checkpoint = Checkpoint(
        run=run_of(request, task, env.control_steps),
        recipe=to_mapping(_recipe(request)),
        image_size=IMAGE_SIZE,
        encoder=None,
        proprioception=True,
        epoch=0,
        dataset="",
        frames=kept.decisions,
        validation_episodes=(),
        train_losses=(),
        validation_losses=(),
        device="cpu",
        code_version=__version__,
    )
    return write_checkpoint(out, checkpoint, weights)
