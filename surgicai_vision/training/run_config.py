"""A run: one policy from its demonstrations to its counted successes, as data.

A `RunConfig` is stored whole wherever results of the run are: in its checkpoint, its evaluation,
the record of its failure and a sweep's folders. Names are printed from it and never parsed.

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
"""Stands for an encoder: a network of the policy's own, trained with it on the images."""
REFERENCES = ("expert", "random", "zero", "replay", "recover")
"""Policies that are not trained: what the trained ones stand beside."""
EXPERTS = ("expert", "recover")
"""Those of them that read the simulator's state."""
LEROBOT_POLICIES = ("act", "diffusion")
"""Policies that a grid trains by `lerobot-train`, for a number of updates."""
ACTORS = ("actor", "bcq")
"""Policies that `rl.train` leaves: they are fed the state with the goal."""
TERMINATIONS = ("privileged", "learned")
"""How a subtask ends under a hierarchical policy."""
BUDGET = "minutes"
"""Setting of a recipe that bounds its training (`policies.chunks.ChunkRecipe`)."""
ACTED_BY = ("execute", "samples", "ensemble")
"""Settings of such a recipe by which chunks are acted; what is learned does not depend on them."""


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
        """What they are to a policy (`bank_of`); across banks, what the least independent is."""
        return bank_of(self.first_seed)


@dataclass(frozen=True)
class Shift:
    """What differs from the training conditions in an evaluation of robustness.

    Attributes:
        axis: a key of `robustness.AXES`.
        strength: 0 to 1.
    """

    axis: str
    strength: float


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides what a run is.

    Attributes:
        env: the task, its scene and what differs from episode to episode: those of the
            demonstrations before an evaluation, those of the evaluation after it.
        encoder: encoder's name; `OWN` for a policy with a network of its own on the images; None
            for a policy without images.
        views: its views, in the order of the features; empty without images.
        policy: policy's name; one of `REFERENCES` for what is not trained.
        pool: what is taken from the encoder.
        privileged: see the state with the goal in place of all else, an upper bound; of a
            hierarchical policy, whether a policy that acts in it sees it.
        recipe: the policy's recipe: a name, or the path of a YAML file.
        changes: what is changed in the recipe, "key=value" each.
        demonstrations: demonstrations trained on, those of the validation split included; None
            for all there are, where they are not counted yet.
        demonstrator: who demonstrated; None where it is not known.
        noise: how much what the demonstrator executed was disturbed.
        post_success_steps: control steps that demonstrations go on after their success.
        frame_stride: control steps from frame to frame of the dataset.
        variants: the looks in which each demonstration was rendered, where a plan says so; None as
            it was recorded, or where it is not known.
        multiplied_from: how many demonstrations those trained on were re-posed from
            (`demos.multiply`), where a plan says so; None where they were not.
        dagger_rounds: rounds of DAgger that the demonstrations hold, where a plan says so.
        recorded_in: the env of the demonstrations, where the evaluation's world is another or
            shifted (`evaluated_in`); None where it is the same.
        updates: updates of the weights and `batch_size`, for LeRobot's policies.
        batch_size: frames of an update, for LeRobot's policies.
        seed: training seed.
        algo: the algorithm of reinforcement or offline learning (`rl.algorithms`) that trained it,
            "residual-td3" for a correction; None for imitation from a dataset.
        env_steps: control steps that it took in the env to learn; 0 offline.
        termination: how subtasks end, where this is a hierarchical policy (`TERMINATIONS`).
        parts: digest of the file that names the policies of a hierarchical policy; empty where
            they are trained by this run.
        expert_swap: the subtask of a hierarchical policy that the expert does.
        acted_by: settings by which its chunks are acted in an evaluation, "key=value" each, in the
            place of its recipe's (`ACTED_BY`).
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
        """Whether a sweep trains it by `lerobot-train`, and not from cached features."""
        return self.policy in LEROBOT_POLICIES and self.updates is not None

    @property
    def is_hierarchical(self) -> bool:
        """Whether this is a high-level policy over low-level ones."""
        return self.termination is not None

    @property
    def sees_goal(self) -> bool:
        """Whether the policy, or one that acts in it, sees the state with the goal.

        No robot knows that state.
        """
        by_state = self.policy in ACTORS and self.encoder is None
        return self.privileged or by_state or self.policy in EXPERTS

    @property
    def inputs(self) -> str:
        """What the policy is fed, in words."""
        if self.encoder:
            return f"{self.encoder}-{'+'.join(self.views)}"
        if self.privileged:
            return "state"
        return "relative" if self.policy in ACTORS and self.algo else "proprioception"

    @property
    def recipe_label(self) -> str:
        """The recipe's name and what is changed in it."""
        return "+".join((Path(self.recipe).stem, *self.changes))

    @property
    def name(self) -> str:
        """How tables and folders call the policy: its inputs and whatever is not as usual.

        With `upset` it ends in "-upset", so that disturbed rows are never taken for others.
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
        if self.expert_swap:
            parts.append(f"expert-{self.expert_swap}")
        return "-".join(parts).replace(":", "-")

    @property
    def recipe_changes(self) -> dict[str, JSON]:
        """Keys of the recipe that are replaced, with their values: the only way to change one."""
        return read_changes(self.changes) | ({"privileged": True} if self.privileged else {})


def with_epochs(changes: tuple[str, ...], epochs: int | None) -> tuple[str, ...]:
    """Return the changes of a recipe with the number of epochs among them, where one is given."""
    return changes if epochs is None else (*changes, f"epochs={epochs}")


def with_budget(
    changes: tuple[str, ...], epochs: int | None, minutes: float | None
) -> tuple[str, ...]:
    """Return the changes of a recipe with the length of the training among them.

    Raises:
        InputError: epochs and minutes are both given.
    """
    if epochs is not None and minutes is not None:
        raise InputError(f"--epochs {epochs} and --minutes {minutes:g} are given; give one.")
    changes = with_epochs(changes, epochs)
    return changes if minutes is None else (*changes, f"{BUDGET}={minutes:g}")


def evaluated_in(run: RunConfig, env: TaskConfig, shift: Shift | None = None) -> RunConfig:
    """Return a run in the env of an evaluation; it remembers the world that it learned in.

    Args:
        run: the run.
        env: the evaluation's, as the shift leaves it.
        shift: what is shifted there, if anything.
    """
    learned = run.recorded_in or run.env
    is_away = (learned.scene, learned.randomisation) != (env.scene, env.randomisation)
    remembers = run.is_trained and (is_away or shift is not None)
    return dataclasses.replace(
        run, env=env, recorded_in=learned if remembers else None, shift=shift
    )


def of_training(run: RunConfig) -> RunConfig:
    """Return a run without what belongs to one evaluation of it."""
    return dataclasses.replace(
        run,
        env=run.recorded_in or run.env,
        recorded_in=None,
        acted_by=(),
        starts=None,
        shift=None,
        expert_swap=None,
        upset=False,
        condition="",
    )
