"""Rolling: one episode by an actor, with every state on the way.

    rollout = roll(env, expert, seed)      # one episode, kept or not

With a `Disturbance` the expert is shown states off its own path: noise on what is executed, while
the label stays the expert's own answer (DART, Laskey et al. 2017), and starts that were pushed away
before the recording begins. With a `Driver` these are states that a learner itself comes to
(DAgger, Ross et al. 2011; `surgicai_vision.experiments.dagger`).
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from surgicai_vision.core.errors import InputError
from surgicai_vision.core.files import code_version
from surgicai_vision.demos.store import Demo

DISTURBANCE_STREAM = 0xDA27
"""Sets the disturbance's random numbers apart from the start's, which are of the same seed."""
PUSH = (8, 25)
"""Fewest and most control steps of a push: 4 to 12 mm at the paper's step size."""


@dataclass(frozen=True)
class Disturbance:
    """What disturbs an episode.

    Attributes:
        noise: standard deviation of the Gaussian noise on the six motions of an executed action, in
            units of its range; the jaw is done as meant, since a random walk of it would drop the
            needle.
        noise_from: lowest such deviation; each episode draws its own between the two. None takes
            `noise` throughout.
        perturb_start_fraction: share of episodes that start with a push in a random direction,
            which is not recorded.
    """

    noise: float = 0.0
    perturb_start_fraction: float = 0.0
    noise_from: float | None = None

    def __post_init__(self) -> None:
        if self.noise_from is not None and not 0.0 <= self.noise_from <= self.noise:
            raise InputError(
                f"noise_from is {self.noise_from:g}; it must be within 0 and noise, {self.noise:g}."
            )
        if not 0.0 <= self.noise <= 1.0 or not 0.0 <= self.perturb_start_fraction <= 1.0:
            raise InputError(
                f"noise is {self.noise:g} and perturb_start_fraction {self.perturb_start_fraction:g}; each must be within 0 and 1."
            )

    def push(self, env: Any, rng: np.random.Generator) -> bool:
        """Push the tool away, or not, as chance has it; say whether the episode is still on."""
        if rng.random() >= self.perturb_start_fraction:
            return True
        direction = np.append(rng.uniform(-1.0, 1.0, 6), 0.0).astype(np.float32)
        for _ in range(rng.integers(*PUSH, endpoint=True)):
            _, _, terminated, truncated, _ = env.step(direction)
            if terminated or truncated:
                return False
        return True

    def deviation(self, rng: np.random.Generator) -> float:
        """Return the standard deviation of an episode's noise."""
        return (
            self.noise
            if self.noise_from is None
            else float(rng.uniform(self.noise_from, self.noise))
        )

    @staticmethod
    def executed(action: np.ndarray, deviation: float, rng: np.random.Generator) -> np.ndarray:
        """Return what is done in the place of `action`, (7,) float32."""
        noisy = action + np.append(rng.normal(0.0, deviation, 6), 0.0)
        return np.clip(noisy, -1.0, 1.0).astype(np.float32)


CALM = Disturbance()


class Actor(Protocol):
    """What records: an expert that sees the environment itself; made anew for every episode.

    One with a true attribute `persists` goes on after its success until the episode's limit.
    """

    def action(self) -> np.ndarray:
        """Return the action (7,) float32 for the environment's present state."""


class Driver(Protocol):
    """What acts in the expert's place at first, while the labels stay the expert's."""

    def begin(self, env: Any, seed: int, rng: np.random.Generator) -> None:
        """Begin an episode: `env` has been reset."""

    def action(self, env: Any, observation: Any) -> np.ndarray | None:
        """Return the action (7,) that is executed; None once the expert acts itself."""


@dataclass(frozen=True)
class Rollout:
    """One rolled episode, whether it succeeded, and why it is not kept if it did not."""

    demo: Demo
    success: bool
    reason: str


def roll(
    env: Any,
    actor: Actor,
    seed: int,
    demonstrator: str = "expert",
    disturbance: Disturbance = CALM,
    post_success_steps: int = 0,
    driver: Driver | None = None,
) -> Rollout:
    """Roll one episode of `env` from `seed` and return it with every state on the way.

    It ends `post_success_steps` control steps after its success: what is shown there is that, and
    how, one stops.
    """
    rng = np.random.default_rng([seed, DISTURBANCE_STREAM])
    env.reset(seed=seed)
    if not disturbance.push(env, rng):
        env.reset(seed=seed)  # the push ended it; this start stays as it was
    deviation = disturbance.deviation(rng)
    observation = env.observe() if driver else None
    if driver:
        driver.begin(env, seed, rng)
    states, rows = [env.get_state()], []
    info: dict[str, Any] = {}
    left = env.config.max_steps if getattr(actor, "persists", False) else post_success_steps
    ended = reached = False
    while not ended:
        phase = env.phase
        action = np.asarray(actor.action(), dtype=np.float32)
        driven = driver.action(env, observation) if driver else None
        executed = (
            disturbance.executed(action, deviation, rng) if deviation and driven is None else action
        )
        executed = executed if driven is None else driven
        observation, reward, _, truncated, info = env.step(executed)
        states.append(env.get_state())
        rows.append((action, executed, phase, reward, info["is_success"], info["contact"]))
        left -= reached
        reached = reached or bool(info["is_success"])
        ended = (reached and left <= 0) or truncated or info["physics_error"]
    actions, sent, phase, reward, success, contact = (
        list(column) for column in zip(*rows, strict=True)
    )
    demo = Demo(
        config=env.config,
        seed=seed,
        demonstrator=demonstrator,
        scene_hash=env.scene.hash,
        code_version=code_version(),
        state=np.stack(states).astype(np.float64),
        action=np.stack(actions),
        phase=np.asarray(phase, dtype=np.int8),
        reward=np.asarray(reward, dtype=np.float32),
        success=np.asarray(success, dtype=bool),
        contact=np.asarray(contact, dtype=bool),
        executed=np.stack(sent) if disturbance.noise or driver else None,
    )
    if info["physics_error"]:
        return Rollout(demo, False, "physics error")
    return Rollout(demo, reached, "" if reached else f"no success in {len(actions)} steps")
