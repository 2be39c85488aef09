"""A correction of a frozen image policy, from reinforcement learning with a sparse reward.

`CorrectionEnv` is the policy's own task. An action corrects what the frozen policy does, within the
bound; the observation is what that policy sees and would do (`policies.residual`). TD3 with
LayerNorm in its critics learns the correction μ. Before its first update only the frozen policy
acts, apart from the noise. The actor is kept close to the frozen policy: it ascends

    λ1 ∇J - λ2 ∇ mean ‖μ‖²

    train_residual(ResidualRequest("outputs/train/grasp-…"), out)

writes a checkpoint of the policy `residual`, which also holds the frozen policy's weights and has
the same inputs. New episodes begin after every training state, whether or not the training was
killed. The folder and the choice of the policy to keep are as in `rl.train`.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast, final

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise
from torch import nn

from policies.base import ACTIONS
from policies.residual import RESIDUAL, Residual, ResidualRecipe
from surgicai_vision import __version__
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import InputError, PhysicsError
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.rollout import run_share
from surgicai_vision.evaluation.slot import env_of
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource
from surgicai_vision.rl.extractor import StandardExtractor
from surgicai_vision.rl.learner import Arrays, State, linear, random_state, set_random_state
from surgicai_vision.rl.nair import AnchoredTD3
from surgicai_vision.rl.residual_config import ALGO, CORRECTION, ResidualRequest
from surgicai_vision.rl.rlpd import LayerNormTD3Policy
from surgicai_vision.rl.settings import read_by
from surgicai_vision.rl.stages import Stages
from surgicai_vision.rl.train import Point, Weights
from surgicai_vision.training import released
from surgicai_vision.training.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from surgicai_vision.training.folder import read_state, training_in, write_state
from surgicai_vision.training.run_config import RunConfig
from surgicai_vision.training.threads import one_thread

PLAYED_EPISODES = 5
"""Episodes of the frozen policy that give the statistics of the correction's input."""
EVALUATED_AT_ONCE = 8
BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")

Vector = NDArray[np.float32]


@final
class CorrectionEnv(gymnasium.Env[Vector, Vector]):
    """The task of a frozen policy, whose actions are corrected; see the module's docstring.

    Args:
        agent: the frozen policy's agent; it renders, encodes and measures the policy's inputs.
        policy: the frozen policy with an untrained correction.
        task: the task's config.
    """

    def __init__(self, agent: PolicyAgent, policy: Residual, task: TaskConfig):
        self._agent = agent
        self._policy = policy
        self._exact = policy.exact()
        self._env = env_of(agent, task)
        self._base = np.zeros(ACTIONS, np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (policy.sight,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Begin an episode from a training start; return the correction's input."""
        super().reset(seed=seed)
        start = int(self.np_random.integers(names.VALIDATION_SEED))
        seen, _ = self._env.reset(seed=start)
        self._agent.reset(0, self._env, start)
        return self._sight(seen), {}

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Take one step with the frozen policy's action plus its correction, (7,) in [-1, 1].

        Raises:
            InputError: the correction is not finite.
        """
        if not np.isfinite(action).all():
            raise _diverged("its actions are")
        moved = np.clip(self._base + self._policy.bound * np.asarray(action), -1.0, 1.0)
        try:
            step = self._env.step(moved.astype(np.float32))
        except PhysicsError:
            sight = np.zeros(self._policy.sight, np.float32)
            return sight, -1.0, True, False, {"is_success": False}
        seen, _, terminated, truncated, info = step
        is_success = bool(info["is_success"])
        reward = 0.0 if is_success else -1.0
        return self._sight(seen), reward, terminated, truncated, {"is_success": is_success}

    def _sight(self, seen: Any) -> Vector:
        """Return the correction's input in the present state; store the frozen policy's action."""
        agent = self._agent
        features = agent.features([seen])
        vectors = agent.vectors([self._env], [seen], agent.times([0], [self._env]))
        exact = self._exact
        with torch.inference_mode():
            observed = torch.from_numpy(exact.observed(features, vectors))
            sight = exact.look(exact.normalise(observed)).float().numpy()[0]
        self._base = sight[-ACTIONS:]
        return np.asarray(sight, np.float32)

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()


@final
class CorrectionTD3(AnchoredTD3):
    """TD3 whose actor is kept close to zero correction; see the module's docstring.

    Its first steps are its own policy's with noise, not random actions. The correction starts at
    zero, so these steps are the frozen policy's.
    """

    def losses(self, batch: Any) -> dict[str, torch.Tensor]:
        """Return the actor's loss and the mean square of the correction, relative to the bound."""
        chosen = self.actor(batch.observations)
        values = self.critic.q1_forward(batch.observations, chosen)
        squares = chosen.square().sum(dim=1).mean()
        return {"actor_loss": self.anchored(values, squares), "correction": squares}

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return super()._sample_action(0, action_noise, n_envs)


def train_residual(
    request: ResidualRequest,
    out: Path,
    *,
    weights: WeightsSource = ANYWHERE,
    progress: Progress | None = None,
) -> Checkpoint:
    """Train a correction, or resume an interrupted training.

    Args:
        request: what is trained.
        out: the checkpoint folder; new, or one of the same request.
        weights: where pretrained weights come from.
        progress: called with (control steps done, control steps in total).

    Raises:
        BadFile: a base that is not a checkpoint.
        InputError: a base that is not a behaviour-cloning policy of one subtask, or that uses
            another policy's progress.
        MissingWeights: the weights of its encoder are not at hand.
        OutputExists: `out` holds something else.
    """
    spec = base_of(request, weights)
    wanted = {
        "code_version": __version__,
        "request": to_mapping(request),
        "base": spec.about["checkpoint"],
    }
    with training_in(out, wanted) as done, torch.random.fork_rng(devices=[]), one_thread():
        if done is not None:
            return done
        training = _Training(request, spec)
        try:
            return training.run(out, progress or silent)
        finally:
            training.close()


def base_of(request: ResidualRequest, weights: WeightsSource = ANYWHERE) -> PolicySpec:
    """Return the policy to correct; see `train_residual` for the errors."""
    spec = open_policy(request.base, weights=weights)
    if spec.run.policy != "bc" or spec.run.task not in names.SUBTASKS:
        raise InputError(
            f"{request.base} is '{spec.run.policy}' of '{spec.run.task}'; only a "
            "behaviour-cloning (bc) policy of one subtask can be corrected."
        )
    checkpoint = read_checkpoint(released.resolve(request.base))
    if checkpoint.recipe.get("denoise", 1) != 1:
        raise InputError(
            f"{request.base} acts on averaged images (denoise), which a correction does not see; "
            "give a policy without denoise."
        )
    if checkpoint.progress_sha256:
        raise InputError(
            f"{request.base} uses another policy's progress; give a policy with a clock."
        )
    return spec


def run_of(request: ResidualRequest, base: RunConfig, env_steps: int | None = None) -> RunConfig:
    """Return the run that a request describes.

    Args:
        request: what is trained.
        base: the run of the policy to correct.
        env_steps: control steps taken; None before training.
    """
    return dataclasses.replace(
        base,
        policy=RESIDUAL.name,
        algo=f"{RESIDUAL.name}-{ALGO}",
        changes=(*base.changes, f"bound={request.bound:g}", *request.changes),
        seed=request.seed,
        env_steps=env_steps,
    )


class _Training:
    """One training: the frozen policy, its task, and the model that learns."""

    def __init__(self, request: ResidualRequest, spec: PolicySpec):
        self.request = request
        self.spec = spec
        agent = spec.make_agent()
        assert isinstance(agent, PolicyAgent)
        base = agent.policy
        self.base = base.checkpoint
        settings = request.settings
        values = {
            **self.base.recipe,
            "bound": request.bound,
            "correction": list(settings.hidden),
            "algo": ALGO,
            "settings": read_by(CORRECTION, settings),
        }
        self.recipe = from_mapping(ResidualRecipe, values, "residual policy")
        torch.manual_seed(request.seed)
        self.policy = Residual(self.recipe, self.base.visual)
        self.policy.take_base(base)
        self.policy.eval().requires_grad_(False)
        self.repeat = spec.config.action_repeat
        self.env = CorrectionEnv(agent, self.policy, spec.config)
        self.policy.standardise(self._played())
        self.model = self._model()

    @property
    def env_steps(self) -> int:
        """Control steps taken: an action is held for `repeat` of them."""
        return self.model.num_timesteps * self.repeat

    def _played(self) -> Vector:
        """Return the correction's input in episodes of the frozen policy alone, (n, sight)."""
        rows = []
        for episode in range(PLAYED_EPISODES):
            sight, _ = self.env.reset(seed=names.TRAIN_SEED + episode)
            ended = False
            while not ended:
                rows.append(sight)
                sight, _, terminated, truncated, _ = self.env.step(np.zeros(ACTIONS, np.float32))
                ended = terminated or truncated
        return np.stack(rows)

    def _model(self) -> CorrectionTD3:
        """Return the model, whose actor is the untrained correction."""
        settings = self.request.settings
        hidden = list(settings.hidden)
        model = CorrectionTD3(
            LayerNormTD3Policy,
            self.env,
            learning_rate=settings.learning_rate,
            gamma=settings.gamma,
            batch_size=settings.batch_size,
            tau=settings.tau,
            buffer_size=self.request.env_steps,
            train_freq=settings.train_every,
            gradient_steps=settings.updates,
            learning_starts=settings.learning_starts,
            policy_delay=settings.policy_delay,
            target_policy_noise=settings.target_noise,
            target_noise_clip=settings.target_noise_clip,
            actor_starts=settings.actor_starts,
            bc_weight=settings.bc_weight,
            normalise_q=settings.normalise_q,
            clip_q=settings.clip_q,
            action_noise=NormalActionNoise(
                np.zeros(ACTIONS), settings.exploration_noise * np.ones(ACTIONS)
            ),
            seed=self.request.seed,
            device="cpu",
            policy_kwargs={
                "activation_fn": nn.ReLU,
                "net_arch": {"pi": hidden, "qf": hidden},
                "n_critics": settings.critics,
                "features_extractor_class": StandardExtractor,
                "features_extractor_kwargs": {
                    "mean": self.policy.sight_mean.tolist(),
                    "std": self.policy.sight_std.tolist(),
                },
            },
        )
        with torch.no_grad():
            for actor in (model.actor, model.actor_target):
                last = linear(actor.mu)[-1]
                last.weight.zero_()
                last.bias.zero_()
        return model

    def run(self, out: Path, progress: Progress) -> Checkpoint:
        """Learn to the end, with periodic evaluations and training states."""
        request = self.request
        repeat = self.repeat

        def show(done: int, total: int, unit: str = "", /) -> None:
            progress(min(done * repeat, request.env_steps), request.env_steps)

        steps = -(-request.env_steps // repeat)
        stages = Stages(steps, -(-request.save_every // repeat), request.seed, out, show)
        save = functools.partial(self._save, out)
        best, kept = stages.run(self.model, self._resume(out), self._evaluate, save)
        return self._write(best, kept, out)

    def _evaluate(self, minutes: float) -> tuple[Point, Weights]:
        """Measure the present policy's successes from validation starts; return its weights too."""
        self.policy.take_correction(linear(self.model.actor.mu))
        rows = []
        if self.request.validation:
            # Entering eval mode again makes a new copy to act, from the present weights.
            corrected = self.policy.eval()
            make = functools.partial(_corrected, self.spec, corrected)
            first = names.VALIDATION_SEED
            seeds = range(first, first + self.request.validation)
            episodes = run_share(
                make, self.spec.config, seeds, EVALUATED_AT_ONCE, report=lambda _: None
            )
            rows = [episode.row for episode in episodes]
        point = Point(
            env_steps=self.env_steps,
            updates=int(self.model._n_updates),
            minutes=minutes,
            successes=sum(row.success for row in rows),
            episodes=len(rows),
            distance_mm=float(np.median([row.d_trans_mm for row in rows])) if rows else 0.0,
        )
        return point, {name: value.clone() for name, value in self.policy.state_dict().items()}

    def _save(self, out: Path, curve: Sequence[Point], best: Weights) -> None:
        """Write the training state, atomically."""
        model = self.model
        buffer = cast(ReplayBuffer, model.replay_buffer)
        rows = buffer.buffer_size if buffer.full else buffer.pos
        state: State = {
            "parameters": model.get_parameters(),
            "steps": model.num_timesteps,
            "updates": model._n_updates,
            "buffer": Arrays.of(buffer, BUFFER, rows),
            "position": [int(buffer.pos), int(buffer.full)],
            "random": random_state(),
            "curve": [dataclasses.asdict(point) for point in curve],
            "best": dict(best),
        }
        write_state(out, state)

    def _resume(self, out: Path) -> tuple[list[Point], Weights]:
        """Resume from the training state, if complete; return the curve and the best weights."""
        state = read_state(out)
        if state is None:
            return [], {}
        model = self.model
        model.set_parameters(state["parameters"], exact_match=True)
        model.num_timesteps = state["steps"]
        model._n_updates = state["updates"]
        buffer = cast(ReplayBuffer, model.replay_buffer)
        Arrays.put(buffer, state["buffer"])
        buffer.pos, full = state["position"]
        buffer.full = bool(full)
        set_random_state(state["random"])
        return [Point(**point) for point in state["curve"]], state["best"]

    def _write(self, weights: Weights, kept: Point, out: Path) -> Checkpoint:
        """Write the policy with these weights, which are those of the point kept."""
        if not all(torch.isfinite(weight).all() for weight in weights.values()):
            raise _diverged("its weights are")
        checkpoint = dataclasses.replace(
            self.base,
            run=run_of(self.request, self.base.run, self.env_steps),
            recipe=to_mapping(self.recipe),
            epoch=0,
            frames=kept.env_steps,
            train_losses=(),
            validation_losses=(),
            device="cpu",
            code_version=__version__,
        )
        return write_checkpoint(out, checkpoint, weights)

    def close(self) -> None:
        """Free the simulator."""
        self.env.close()


def _diverged(what: str) -> InputError:
    """Return the error for a correction that diverged."""
    return InputError(f"The correction diverged: {what} not finite; lower the learning rate.")


def _corrected(spec: PolicySpec, policy: Residual) -> PolicyAgent:
    """Return the frozen policy's agent with the corrected policy instead."""
    agent = spec.make_agent()
    assert isinstance(agent, PolicyAgent)
    agent.policy = policy
    return agent
