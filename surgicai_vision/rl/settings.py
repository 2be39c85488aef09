"""Settings of all algorithms, and the request of a training, as frozen data."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import final

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, SuccessRule, TaskConfig, check_hidden, from_mapping
from surgicai_vision.core.errors import (
    InputError,
    UnknownName,
    check_at_least,
    check_finite,
    check_name,
    check_positive,
)
from surgicai_vision.core.tasks import load_subtask
from surgicai_vision.rl.algorithms import ALGORITHMS, Algorithm

OBSERVATIONS = ("relative", "state")
DEMANDS = ("auto", "achieved", "kept")
LARGEST_SEED = 2**32 - 1
"""Largest seed of Stable-Baselines3 and d3rlpy, as of NumPy's legacy generator."""
LEAST_BATCH = 2
"""Smallest batch or rollout: PPO standardises over one, and a policy's recipe records no less."""
FIRST_RANDOM_STEPS = 1000
"""Random steps before the first update of an algorithm without demonstrations."""
STOP_AFTER = 2
"""Evaluations in a row that must reach `Settings.stop_at`."""


@final
@dataclass(frozen=True)
class Settings:
    """Settings; each algorithm reads those that `Algorithm.settings` names.

    "Paper" means SurgicAI's appendix, "code" its release. Where neither is named, the default is
    the library's.

    Attributes:
        hidden: width of each hidden layer of actor and critics (paper 4 × 256, code 3 × 256).
        learning_rate: Adam's learning rate (code 2e-4).
        gamma: discount per decision (paper .99, code .995).
        batch_size: transitions per update (code 256).
        envs: envs stepped at the same time; the number of worker processes changes no result.
        tau: Polyak factor of the target networks (code .005).
        train_every: steps of an env between updates.
        updates: updates each time, for each env.
        learning_starts: env steps with random actions before the first update; 0 takes 1,000, or
            one episode if that is longer; with demonstrations one episode. Hindsight needs at
            least one episode (`Request.episode`).
        critics: number of critics; the smallest of their values is used.
        exploration_noise: standard deviation of the noise on actions (code .05).
        actor_starts: critic updates before the actor's first update, for a correction.
        policy_delay: critic updates per actor update (code 2).
        target_noise: standard deviation of the noise on the target's action (code .2).
        target_noise_clip: limit to which that noise is clipped (code .5).
        goals: relabelled transitions for each real one (paper 3, code 4), using future states.
        relabel_demand: what a relabelled goal requires besides the pose: "achieved", what held at
            that time, as in the paper; "kept", what the task requires; "auto" keeps it if the task
            requires holes or the needle being out, which "go there" would otherwise replace.
        demo_share: share of a batch that is drawn from the demonstrations (code .3), rounded to
            whole transitions; at least one is a demonstration, and at least one is not.
        bc_weight: λ2, weight of the cloning loss; λ1 = 1 - λ2 is that of the critic's value (paper
            .2, .5, .8; .5 by default). For a correction's actor, the frozen policy is cloned.
        q_filter: clone only where the critic values the demonstrated action above the actor's.
        normalise_q: divide the critic's value in the actor's loss by its mean absolute value, so
            that λ2 has the same effect at every scale of reward (Fujimoto and Gu, A minimalist
            approach to offline reinforcement learning, NeurIPS 2021).
        clip_q: clip targets to the possible returns of the reward, [-1 / (1 - γ), 0].
        rollout: steps of all envs between updates (PPO).
        samples: actions sampled per state by BCQ and Cal-QL (their papers' code: 100 and 10).
        stop_at: share of validation starts; learning ends once `STOP_AFTER` evaluations in a row
            have solved this share. With 0 it continues to the last step.
        success_steps: `SuccessRule.steps`, for an episode of learning or a demonstration. With 1,
            the paper's value, nothing is learned about what comes after, and the next subtask of a
            whole procedure finds the previous one unfinished.
        tolerance_share: `SuccessRule.tolerance_share`. With 1, the paper's value, an actor learns
            to stop at the edge of the tolerance.
        keeps_holes: `SuccessRule.keeps_holes`. If False, as in the paper, an actor may learn
            handoffs that pull the needle out of the tissue.
    """

    hidden: tuple[int, ...] = (256, 256, 256)
    learning_rate: float = 1e-3
    gamma: float = 0.99
    batch_size: int = 256
    envs: int = 1
    tau: float = 0.005
    train_every: int = 2
    updates: int = 1
    learning_starts: int = 0
    critics: int = 2
    exploration_noise: float = 0.1
    actor_starts: int = 0
    policy_delay: int = 2
    target_noise: float = 0.2
    target_noise_clip: float = 0.5
    goals: int = 4
    relabel_demand: str = "auto"
    demo_share: float = 0.3
    bc_weight: float = 0.5
    q_filter: bool = True
    normalise_q: bool = True
    clip_q: bool = True
    rollout: int = 2048
    samples: int = 10
    stop_at: float = 0.0
    success_steps: int = 1
    tolerance_share: float = 1.0
    keeps_holes: bool = False

    def __post_init__(self) -> None:
        check_name("relabel_demand", self.relabel_demand, DEMANDS)
        check_positive(
            learning_rate=self.learning_rate,
            envs=self.envs,
            train_every=self.train_every,
            updates=self.updates,
            critics=self.critics,
            policy_delay=self.policy_delay,
            goals=self.goals,
            rollout=self.rollout,
            samples=self.samples,
        )
        check_at_least(
            0,
            learning_starts=self.learning_starts,
            actor_starts=self.actor_starts,
            exploration_noise=self.exploration_noise,
            target_noise=self.target_noise,
            target_noise_clip=self.target_noise_clip,
        )
        check_finite(
            learning_rate=self.learning_rate,
            exploration_noise=self.exploration_noise,
            target_noise=self.target_noise,
        )
        check_at_least(LEAST_BATCH, batch_size=self.batch_size)
        for name in ("gamma", "tau", "demo_share", "bc_weight"):
            if not 0 < getattr(self, name) < 1:
                raise InputError(
                    f"{name} is {getattr(self, name)}; it must be above 0 and below 1."
                )
        check_hidden(self.hidden)
        if not 0 <= self.stop_at <= 1:
            raise InputError(f"stop_at is {self.stop_at}; it must be a share from 0 to 1.")
        _ = self.success_rule  # refuses what is not allowed

    @property
    def success_rule(self) -> SuccessRule:
        """What a success requires in learning beyond the paper's rule."""
        return SuccessRule(self.success_steps, self.tolerance_share, self.keeps_holes)


@final
@dataclass(frozen=True)
class Request:
    """Everything that determines the result of a training.

    Attributes:
        algo: a key of `ALGORITHMS`.
        env: the task, with its options.
        observation: the policy's input, "relative" or "state".
        settings: all settings, including the algorithm's defaults.
        changes: the settings that were changed, "key=value" each; they enter the run's name.
        env_steps: control steps taken in the env; 0 for offline algorithms.
        updates: updates of offline algorithms; 0 online.
        seed: seed of networks, batches, noise and starts.
        demonstrations: number of demonstrations it learns from; 0 for none.
        demos: sha256 over their files.
        validation: episodes of each evaluation during training, from validation starts.
        save_every: control steps (offline: updates) between evaluations and training states.
    """

    algo: str
    env: TaskConfig = field(default_factory=TaskConfig)
    observation: str = "relative"
    settings: Settings = field(default_factory=Settings)
    changes: tuple[str, ...] = ()
    env_steps: int = 0
    updates: int = 0
    seed: int = 0
    demonstrations: int = 0
    demos: str = ""
    validation: int = 20
    save_every: int = 5000

    def __post_init__(self) -> None:
        algorithm = self.algorithm
        check_name("observation", self.observation, OBSERVATIONS)
        given, needed = (
            ("env_steps", "updates") if algorithm.is_online else ("updates", "env_steps")
        )
        if getattr(self, given) < 1 or getattr(self, needed):
            raise InputError(f"'{self.algo}' needs {given} of at least 1, and no {needed}.")
        if algorithm.needs_demos and not self.demonstrations:
            raise InputError(f"'{self.algo}' learns from demonstrations; give some.")
        if not algorithm.needs_demos and self.demonstrations:
            raise InputError(f"'{self.algo}' does not learn from demonstrations; leave them out.")
        if algorithm.has_hindsight and self.observation != "relative":
            raise InputError(
                f"'{self.algo}' relabels goals, which obs_type 'state' does not show separately; "
                "give observation relative."
            )
        if algorithm.has_hindsight and self.env.task not in names.SUBTASKS:
            raise InputError(
                f"'{self.algo}' relabels the goal of one subtask; '{self.env.task}' has several."
            )
        if algorithm.has_hindsight and self.env.reward != "sparse":
            raise InputError(f"'{self.algo}' needs the sparse reward, not '{self.env.reward}'.")
        if self.env.task == names.SUTURE and self.settings.success_rule != SuccessRule():
            raise InputError(
                "success_steps, tolerance_share and keeps_holes are for one subtask; "
                f"'{names.SUTURE}' has its own rule of when a subtask is over. Leave them out."
            )
        self._check_batches()
        if self.save_every < 1 or self.validation < 0 or self.seed < 0:
            raise InputError(
                f"save_every is {self.save_every}, validation {self.validation}, seed "
                f"{self.seed}; they must be at least 1, 0 and 0."
            )
        if self.settings.stop_at and not self.validation:
            raise InputError("stop_at refers to validation starts; give validation of at least 1.")

    def _check_batches(self) -> None:
        """Refuse settings with which a batch cannot be drawn, or is not mixed as it should be."""
        algorithm = self.algorithm
        settings = self.settings
        if algorithm.has_hindsight and 0 < settings.learning_starts < self.episode:
            raise InputError(
                f"learning_starts is {settings.learning_starts}; hindsight needs whole episodes "
                f"before the first update. Give at least {self.episode}, or 0."
            )
        before = self.random_steps * self.env.action_repeat
        if "learning_starts" in algorithm.settings and self.env_steps <= before:
            raise InputError(
                f"env_steps is {self.env_steps}, but the first {before} have random actions and "
                "nothing is learned in them; give more, or a lower learning_starts."
            )
        if "rollout" in algorithm.settings:
            check_at_least(LEAST_BATCH, rollout=settings.rollout)
        rows = demonstration_rows(settings.demo_share, settings.batch_size)
        if "demo_share" in algorithm.settings and not 0 < rows < settings.batch_size:
            raise InputError(
                f"demo_share is {settings.demo_share}, so {rows} of the {settings.batch_size} "
                "transitions of a batch would be demonstrations; at least one must be, and at "
                "least one must not."
            )

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm."""
        return ALGORITHMS[check_name("algo", self.algo, ALGORITHMS)]

    @property
    def total(self) -> int:
        """Control steps to take, or updates of an offline algorithm."""
        return self.env_steps if self.algorithm.is_online else self.updates

    @property
    def episode(self) -> int:
        """Env steps, over all envs, within which each env has finished an episode."""
        return (self.env.max_steps // self.env.action_repeat + 1) * self.settings.envs

    @property
    def random_steps(self) -> int:
        """Env steps with random actions before the first update, over all envs."""
        if self.settings.learning_starts:
            return self.settings.learning_starts
        if self.algorithm.needs_demos:
            return self.episode
        return max(self.episode, FIRST_RANDOM_STEPS)

    @property
    def keeps_demand(self) -> bool:
        """Whether a relabelled goal keeps the requirement of the task."""
        if self.settings.relabel_demand != "auto":
            return self.settings.relabel_demand == "kept"
        demands = load_subtask(self.env.task).demands[self.env.tolerance]
        return bool(demands.holes or demands.out)


def demonstration_rows(demo_share: float, batch_size: int) -> int:
    """Return how many transitions of a batch are demonstrations."""
    return round(demo_share * batch_size)


def settings_of(algo: str, changes: Mapping[str, JSON]) -> Settings:
    """Return the settings of an algorithm with changes.

    Args:
        algo: a key of `ALGORITHMS`.
        changes: settings to replace.

    Raises:
        UnknownName: an algorithm, or a setting that it does not read.
        InputError: a value that is not allowed.
    """
    algorithm = ALGORITHMS[check_name("algo", algo, ALGORITHMS)]
    return changed_settings(algorithm, algo, changes)


def changed_settings(algorithm: Algorithm, name: str, changes: Mapping[str, JSON]) -> Settings:
    """Return the settings of the algorithm with this name, with changes; see `settings_of`."""
    for key in changes:
        if key not in algorithm.settings:
            raise UnknownName(f"setting of '{name}'", key, algorithm.settings)
    return from_mapping(Settings, {**algorithm.defaults, **changes}, f"settings of '{name}'")


def read_by(algorithm: Algorithm, settings: Settings) -> dict[str, JSON]:
    """Return the settings that an algorithm reads, as data."""
    values = asdict(settings)
    return {key: values[key] for key in algorithm.settings}
