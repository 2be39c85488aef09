"""A run: one policy from its demonstrations to its measured successes, as data.

A `RunConfig` is stored in full wherever results of the run are: in its checkpoint, its evaluation,
the record of its failure and a sweep's folders. Names are derived from it and never parsed.

Light to import, for the command line.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

from surgicai_vision.core import names
from surgicai_vision.core.banks import bank_of
from surgicai_vision.core.cameras import check_view
from surgicai_vision.core.config import JSON, LATER, TaskConfig, read_changes
from surgicai_vision.core.errors import InputError, check_at_least, check_name
from surgicai_vision.core.variants import Variants

OWN = "own"
"""Name used instead of an encoder's: the policy trains its own network on the images."""
REFERENCES = ("expert", "random", "zero", "replay", "recover")
"""Policies that are not trained: references for the trained ones."""
EXPERTS = ("expert", "recover")
"""References that read the simulator's state."""
LEROBOT_POLICIES = ("act", "diffusion")
"""Policies that a grid trains with `lerobot-train`, for a number of updates."""
ACTORS = ("actor", "bcq")
"""Policies that `rl.train` produces: they are fed the state with the goal."""
TERMINATIONS = ("privileged", "learned")
"""How a subtask ends under a hierarchical policy."""
BUDGET = "minutes"
"""Recipe setting that limits the training time (`policies.chunks.ChunkRecipe`)."""
ACTED_BY = (
    *("speed", "jaw_speed", "pinch_speed", "clock_speed", "retry_after", "denoise"),
    *("execute", "samples", "ensemble", "measure_delay"),
)
"""Settings of a recipe that do not affect what is learned: speeds, when the next attempt begins,
whether images are averaged, and how chunks are executed."""


@dataclass(frozen=True)
class Starts:
    """Start states of an evaluation: consecutive seeds.

    Attributes:
        first_seed: seed of the first start.
        episodes: number of starts.
    """

    first_seed: int = names.TEST_SEED
    episodes: int = 20

    @property
    def seeds(self) -> range:
        """The seed of each start."""
        return range(self.first_seed, self.first_seed + self.episodes)

    @property
    def bank(self) -> str:
        """Bank of these starts (`bank_of`); across banks, that of the least independent start."""
        return bank_of(self.first_seed)


@dataclass(frozen=True)
class Shift:
    """What differs from the training conditions in an evaluation of robustness.

    Attributes:
        axis: a key of `robustness.SHIFTS`.
        strength: 0 to 1.
    """

    axis: str
    strength: float


@dataclass(frozen=True)
class RunConfig:
    """Everything that defines a run.

    Attributes:
        env: the task, its scene and what varies between episodes: those of the demonstrations
            before an evaluation, those of the evaluation after it.
        encoder: encoder's name; `OWN` for a policy with its own network on the images; None for a
            policy without images.
        views: its views, in the order of the features; empty without images.
        policy: policy's name; one of `REFERENCES` if it is not trained.
        pool: which output of the encoder is used.
        privileged: see only the state with the goal, an upper bound; for a hierarchical policy,
            whether any policy within it sees that state.
        recipe: the policy's recipe: a name, or the path of a YAML file.
        changes: changes to the recipe, "key=value" each.
        demonstrations: number of demonstrations trained on, including the validation split; None
            for all available, if they are not counted yet.
        demonstrator: who demonstrated; None if unknown.
        noise: strength of the disturbance of the demonstrator's executed actions.
        post_success_steps: control steps that demonstrations continue after their success.
        frame_stride: control steps between frames of the dataset.
        variants: the looks in which each demonstration was rendered; None if as recorded, or
            unknown.
        multiplied_from: number of demonstrations from which those trained on were re-posed
            (`demos.multiply`), if a plan sets it; None if they were not.
        dagger_rounds: DAgger rounds included in the demonstrations, if a plan sets them.
        recorded_in: the env of the demonstrations, if the evaluation's world differs or is shifted
            (`evaluated_in`); None if it is the same.
        updates: updates of the weights, for LeRobot's policies and offline learning; decisions, for
            a high-level policy trained by PPO.
        batch_size: frames per update, for LeRobot's policies.
        seed: training seed.
        algo: the algorithm of reinforcement or offline learning (`rl.algorithms`) that trained it,
            "residual-td3" for a correction; None for imitation from a dataset.
        env_steps: control steps taken in the env for learning; 0 offline.
        termination: how subtasks end, if this is a hierarchical policy (`TERMINATIONS`).
        parts: digest of the file that names the policies of a hierarchical policy; empty if this
            run trains them.
        expert_swap: the subtask of a hierarchical policy that the expert performs.
        acted_by: settings by which it acts in an evaluation, "key=value" each, instead of its
            recipe's (`ACTED_BY`).
        detector: hash of the weights of the detector that aims its crops in an evaluation
            (`evaluation.aimed_agent`); empty if crops lie where the arm reports its jaws.
        starts: start states of the evaluation; None before it.
        shift: what is shifted in an evaluation of robustness.
        upset: one thing goes wrong in every episode of the evaluation (`envs.upset`).
        condition: name of the condition of a plan (`experiments.plan_config`) that it is evaluated
            in; empty elsewhere.
    """

    env: TaskConfig = field(default_factory=TaskConfig)
    encoder: str | None = None
    views: tuple[str, ...] = ()
    policy: str = "bc"
    pool: str = "global"
    privileged: bool = False
    recipe: str = "paper"
    changes: tuple[str, ...] = ()
    demonstrations: int | None = None
    demonstrator: str | None = None
    noise: float = 0.0
    post_success_steps: int = 0
    frame_stride: int = 1
    variants: Variants | None = field(default=None, metadata=LATER)
    multiplied_from: int | None = field(default=None, metadata=LATER)
    dagger_rounds: int = field(default=0, metadata=LATER)
    recorded_in: TaskConfig | None = field(default=None, metadata=LATER)
    updates: int | None = None
    batch_size: int | None = None
    seed: int = 0
    algo: str | None = None
    env_steps: int | None = None
    termination: str | None = None
    parts: str = ""
    expert_swap: str | None = None
    acted_by: tuple[str, ...] = field(default=(), metadata=LATER)
    detector: str = field(default="", metadata=LATER)
    starts: Starts | None = None
    shift: Shift | None = None
    upset: bool = False
    condition: str = ""

    def __post_init__(self) -> None:
        check_at_least(0, seed=self.seed)
        for view in self.views:
            check_view(view)
        if len(set(self.views)) != len(self.views):
            raise InputError(f"Views {', '.join(self.views)} are given; give each view once.")
        if self.encoder is not None and not self.views:
            raise InputError(
                f"Encoder '{self.encoder}' is given without views; give both or neither."
            )
        if self.encoder is None and self.views and not self.parts:
            raise InputError(
                f"Views {', '.join(self.views)} are given without an encoder; give both or neither."
            )
        if self.expert_swap is not None:
            check_name("subtask", self.expert_swap, names.SUBTASKS)
        if self.termination is None:
            return
        check_name("termination", self.termination, TERMINATIONS)
        if any(map(names.is_depth_view, self.views)):
            raise InputError(
                f"A hierarchical policy sees no depth views ({', '.join(self.views)}); "
                "give views in colour."
            )

    @property
    def task(self) -> str:
        """The task's name."""
        return self.env.task

    @property
    def is_trained(self) -> bool:
        """Whether a policy is trained."""
        return self.policy not in REFERENCES

    @property
    def by_lerobot_train(self) -> bool:
        """Whether a sweep trains it with `lerobot-train`, and not from cached features."""
        return self.policy in LEROBOT_POLICIES and self.updates is not None

    @property
    def is_hierarchical(self) -> bool:
        """Whether this is a high-level policy over low-level ones."""
        return self.termination is not None

    @property
    def sees_goal(self) -> bool:
        """Whether the policy, or any policy within it, sees the state with the goal.

        No robot knows that state.
        """
        by_state = self.policy in ACTORS and self.encoder is None
        return self.privileged or by_state or self.policy in EXPERTS

    @property
    def inputs(self) -> str:
        """The policy's inputs, in words."""
        if self.encoder:
            return f"{self.encoder}-{'+'.join(self.views)}"
        if self.privileged:
            return "state"
        return "relative" if self.policy in ACTORS and self.algo else "proprioception"

    @property
    def recipe_label(self) -> str:
        """The recipe's name and its changes."""
        return "+".join((Path(self.recipe).stem, *self.changes))

    @property
    def name(self) -> str:
        """The policy's name in tables and folders: its inputs and all that is not the default.

        With `upset` it ends in "-upset", so that disturbed rows are never mistaken for others.
        """
        return f"{self._name}-upset" if self.upset else self._name

    @property
    def _name(self) -> str:
        """The name of the policy itself."""
        if not self.is_trained:
            return self.policy
        parts = [f"hierarchical-{self.termination}"] if self.is_hierarchical else []
        if self.parts:
            parts.append(self.parts[:8])
        elif self.algo:
            parts += [self.algo, self.inputs, *self.changes]
        else:
            parts += [self.policy] if self.policy != "bc" else []
            parts.append(self.inputs)
            parts += [self.pool] if self.pool != "global" else []
            parts += [self.recipe_label] if self.recipe_label != "paper" else []
            parts += [self.variants.name] if self.variants else []
            parts += [f"from-{self.multiplied_from}"] if self.multiplied_from else []
            parts += [f"dagger-{self.dagger_rounds}"] if self.dagger_rounds else []
            parts += ["+".join(("acting", *self.acted_by))] if self.acted_by else []
        if self.detector:
            parts.append(f"aimed-{self.detector[:8]}")
        if self.expert_swap:
            parts.append(f"expert-{self.expert_swap}")
        return "-".join(parts).replace(":", "-")

    @property
    def recipe_changes(self) -> dict[str, JSON]:
        """Recipe keys that are replaced, with their values: the only way to change a recipe."""
        return read_changes(self.changes) | ({"privileged": True} if self.privileged else {})


def with_epochs(changes: tuple[str, ...], epochs: int | None) -> tuple[str, ...]:
    """Return a recipe's changes, including the number of epochs if one is given."""
    return changes if epochs is None else (*changes, f"epochs={epochs}")


def with_budget(
    changes: tuple[str, ...], epochs: int | None, minutes: float | None
) -> tuple[str, ...]:
    """Return a recipe's changes, including the length of the training if one is given.

    Raises:
        InputError: epochs and minutes are both given.
    """
    if epochs is not None and minutes is not None:
        raise InputError(f"--epochs {epochs} and --minutes {minutes:g} are given; give one.")
    changes = with_epochs(changes, epochs)
    return changes if minutes is None else (*changes, f"{BUDGET}={minutes:g}")


def evaluated_in(run: RunConfig, env: TaskConfig, shift: Shift | None = None) -> RunConfig:
    """Return a run with the env of an evaluation; it still records the world it learned in.

    Args:
        run: the run.
        env: the evaluation's env, with the shift applied.
        shift: what is shifted there, if anything.
    """
    learned = run.recorded_in or run.env
    is_away = (learned.scene, learned.randomisation) != (env.scene, env.randomisation)
    remembers = run.is_trained and (is_away or shift is not None)
    return dataclasses.replace(
        run, env=env, recorded_in=learned if remembers else None, shift=shift
    )


def of_training(run: RunConfig) -> RunConfig:
    """Return a run without the fields that belong to one evaluation of it."""
    return dataclasses.replace(
        run,
        env=run.recorded_in or run.env,
        recorded_in=None,
        acted_by=(),
        detector="",
        starts=None,
        shift=None,
        expert_swap=None,
        upset=False,
        condition="",
    )
