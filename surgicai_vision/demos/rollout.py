"""Rollout: one episode by a demonstrator, with every state along the way.

    result = rollout(env, expert, seed)      # one episode, kept or not

With a `Disturbance` the demonstrator meets states off its own path. There is noise on what is
executed, while the label remains its own answer (DART, Laskey et al. 2017), the tool aims past the
grasp for a while, and starts are perturbed before the recording begins. With a `BehaviourPolicy`
these are the states that a learner itself reaches (DAgger, Ross et al. 2011;
`surgicai_vision.experiments.dagger`). With upsets (`envs.upset`) something goes wrong once, and a
demonstrator that can (`demos.recovery_expert`) goes back to correct it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.files import code_version
from surgicai_vision.demos.demonstrator import ON_AIM, BehaviourPolicy, Demonstrator
from surgicai_vision.demos.disturbance import AIM_STEPS, UNDISTURBED, Disturbance
from surgicai_vision.demos.store import Demo
from surgicai_vision.envs.upset import Upset, plan_upset

if TYPE_CHECKING:
    from surgicai_vision.envs.base import Observation, SuturingEnv
    from surgicai_vision.envs.success import Info

DISTURBANCE_STREAM = 0xDA27
"""Separates the disturbance's random numbers from the start's, which use the same seed."""


class EpisodeRecorder:
    """Records one episode step by step, with every state along the way.

    Args:
        env: the env, at its start state.
        seed: seed of the start.
        demonstrator: the demonstrator's name, as it is stored.

    Attributes:
        info: the info of the last step.
        observation: the observation after the last step.
        truncated: whether the last step reached the episode's limit.
    """

    def __init__(self, env: "SuturingEnv", seed: int, demonstrator: str):
        self.seed = seed
        self.info: Info = {}
        self.observation: Observation | None = None
        self.truncated = False
        self._env = env
        self._demonstrator = demonstrator
        self._states = [env.get_state()]
        self._rows: list[
            tuple[NDArray[np.float32], NDArray[np.float32], int, float, bool, bool]
        ] = []

    def __len__(self) -> int:
        """Return the number of control steps so far."""
        return len(self._rows)

    @property
    def success(self) -> bool:
        """Return True if the last step met the task."""
        return bool(self.info.get("is_success"))

    @property
    def is_physical(self) -> bool:
        """Return True unless the physics diverged."""
        return not self.info.get("physics_error")

    def step(self, action: NDArray[np.float32], label: NDArray[np.float32] | None = None) -> bool:
        """Take a step and return True if the env ended the episode.

        Args:
            action: the executed action (7,).
            label: the demonstrator's action (7,) if it differs.
        """
        phase = self._env.phase
        self.observation, reward, terminated, self.truncated, self.info = self._env.step(action)
        self._states.append(self._env.get_state())
        success, contact = self.info["is_success"], self.info["contact"]
        label = action if label is None else label
        self._rows.append((label, action, phase, reward, success, contact))
        return bool(terminated or self.truncated)

    def restate(self) -> None:
        """Replace the last state by the env's present one, after a change between two steps."""
        self._states[-1] = self._env.get_state()

    def demo(self, with_executed: bool = False, source: str = "") -> Demo:
        """Return the episode as a demonstration.

        Args:
            with_executed: include the executed actions alongside the labels.
            source: sha256 of the file of the demonstration that it re-poses.
        """
        labels, actions, phases, rewards, successes, contacts = zip(*self._rows, strict=True)
        return Demo(
            config=self._env.config,
            seed=self.seed,
            demonstrator=self._demonstrator,
            scene_hash=self._env.scene.hash,
            code_version=code_version(),
            state=np.stack(self._states).astype(np.float64),
            action=np.stack(labels).astype(np.float32),
            phase=np.asarray(phases, dtype=np.int8),
            reward=np.asarray(rewards, dtype=np.float32),
            success=np.asarray(successes, dtype=bool),
            contact=np.asarray(contacts, dtype=bool),
            executed=np.stack(actions) if with_executed else None,
            source=source,
        )


@dataclass(frozen=True)
class Rollout:
    """One episode.

    Attributes:
        demo: what happened.
        success: whether it met the task.
        reason: why it is not kept; "" after a success.
        upset: what went wrong, one of `envs.upset.KINDS`; "" where nothing did.
    """

    demo: Demo
    success: bool
    reason: str
    upset: str = ""


def rollout(
    env: "SuturingEnv",
    demonstrator: Demonstrator,
    seed: int,
    name: str = "expert",
    disturbance: Disturbance = UNDISTURBED,
    post_success_steps: int = 0,
    behaviour: BehaviourPolicy | None = None,
) -> Rollout:
    """Run one episode of `env` from `seed` and return it with every state along the way.

    Args:
        env: the env; it is reset.
        demonstrator: labels every state, and acts where `behaviour` does not.
        seed: seed of the start and of all randomness in the episode.
        name: the demonstrator's name, as it is stored.
        disturbance: noise, perturbed starts and upsets.
        post_success_steps: control steps recorded after the success, which show how to stop.
        behaviour: acts instead of the demonstrator at first.
    """
    rng = np.random.default_rng([seed, DISTURBANCE_STREAM])
    env.reset(seed=seed)
    if not disturbance.perturb_start(env, rng):
        env.reset(seed=seed)  # the perturbation ended the episode; this start is left unperturbed
    deviation = disturbance.draw_deviation(rng)
    is_noisy = bool(disturbance.noise or disturbance.jaw_noise or disturbance.aim_noise)
    miss = ON_AIM
    demonstrator.late = disturbance.draw_late(rng)
    observation = env.observe() if behaviour else None
    if behaviour:
        behaviour.reset(env, seed, rng)

    fraction = disturbance.upset_fraction
    upset = Upset(env, plan_upset(seed, env.task, fraction) if fraction else None)
    recorder = EpisodeRecorder(env, seed, name)
    steps_left = env.config.max_steps if demonstrator.persists else post_success_steps
    ended = False
    succeeded = False
    while not ended:
        phase = env.phase
        is_pushed = upset.before_step()
        label = np.asarray(demonstrator.action(), dtype=np.float32)
        if is_pushed or env.phase != phase:
            recorder.restate()
            observation = env.observe() if behaviour else None
        if disturbance.aim_noise and len(recorder) % AIM_STEPS == 0:
            miss = disturbance.draw_aim(env.task, rng)
        executed = None
        if behaviour and observation is not None:
            executed = behaviour.action(env, observation)
        if executed is None:
            # The jaw follows the label: a tool that aims past the grasp does not close there.
            acted = label
            if miss != ON_AIM:
                acted = np.append(demonstrator.missing(miss)[:6], label[6])
            executed = disturbance.disturb(acted, deviation, rng) if is_noisy else label
        recorder.step(upset.altered(executed), label)
        observation = recorder.observation
        if succeeded:
            steps_left -= 1
        succeeded = succeeded or recorder.success
        ended = (
            (succeeded and steps_left <= 0)
            or recorder.truncated
            or not recorder.is_physical
            or bool(demonstrator.gives_up)
        )

    with_executed = bool(is_noisy or behaviour or fraction)
    demo = recorder.demo(with_executed, demonstrator.source)
    if not recorder.is_physical:
        return Rollout(demo, False, "physics error", upset.kind)
    reason = demonstrator.gives_up or f"no success in {len(demo)} steps"
    return Rollout(demo, succeeded, "" if succeeded else reason, upset.kind)
