"""Plan: a set of policies rebuilt from scratch, as data; light to import, for the command line.

A plan is one YAML file that says what is recorded and rendered (`demonstrations`), what is trained
on what (`policies`), and what is evaluated in which conditions (`conditions`):

    size: 224
    encoder: imagenet-lite-early         # of every policy with views that names no other
    pool: spatial
    recipe: best                         # likewise
    seed: [0, 1, 2]                      # training seeds; each has its own demonstrations
    episodes: 100                        # held-out starts of each evaluation
    demonstrations:
      - {name: search, task: grasp, episodes: 350, demonstrator: search, view: [front_psm2]}
      - {name: whole, task: suture, episodes: 160, view: [front_psm1, front_psm2]}
    policies:
      - {name: grasp, demonstrations: search, view: [front_psm2]}
      - {name: place, demonstrations: whole, subtask: place, view: [front_psm2]}
      - …                                # insert, handoff, pullout
      - {name: hlp, demonstrations: whole, policy: hlp}
    procedure: {grasp_hold: 5}           # fields of `HierarchicalConfig`
    conditions:
      - {name: standing}                 # every policy that acts, and the whole procedure
      - {name: moved, policies: [suture], env: {randomisation: {phantom_shift: 10}}}
      - {name: privileged, policies: [suture], procedure: {termination: privileged}}

A policy's `part`, or else its name, says which part of the whole procedure it does: the five
subtasks and `hlp` make up `suture`. So a plan may have both a `grasp`, evaluated on its own task,
and a `{name: suture-grasp, part: grasp, …}` for whole procedures.
A plan that differs from another in a few keys names that plan and gives only these keys:

    base: endoscope                      # a shipped plan, or a file's path from this one's folder
    env: {scene: {tissue: soft}}         # a key replaces the base's key as a whole
    conditions: [{name: soft}]

Two commands take a plan:

* `surgicai-vision sweep PLAN.yaml`: every training seed in every condition, in one folder
  (`experiments.sweep`); a condition's starts are the same for every seed, and the same as those of
  the other conditions. Seeds and conditions may be added later, in the same folder.
* `surgicai-vision release --plan PLAN.yaml`: only its first training seed, evaluated as trained;
  these become the policies that come with the product (`experiments.release`).

`plan_parts` defines what a plan lists, `plan_check` what is refused before any work.

Everything a seed's policies are made from depends on that seed: `dataset_config.first_seed` gives
each seed demonstrations that no other seed has. None of them begins at a start of an evaluation.
"""

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from surgicai_vision.core import names
from surgicai_vision.core.banks import BANKS
from surgicai_vision.core.cameras import view_names
from surgicai_vision.core.config import (
    JSON,
    TaskConfig,
    digest,
    from_mapping,
    to_identity,
    to_mapping,
)
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.files import configs_folder, read_yaml
from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig
from surgicai_vision.experiments.dataset_config import (
    DatasetConfig,
    Demonstrations,
    first_seed,
)
from surgicai_vision.experiments.plan_check import check_plan
from surgicai_vision.experiments.plan_parts import (
    AS_TRAINED,
    PARTS,
    Condition,
    NotRun,
    PlannedPolicy,
)
from surgicai_vision.experiments.sweep.experiment import Evaluated, Training
from surgicai_vision.training.run_config import (
    BUDGET,
    OWN,
    RunConfig,
    Starts,
    evaluated_in,
    with_epochs,
)

BASE = "base"
"""A plan file's key that names the plan it differs from."""

RELEASED_PLAN = Path("sweep") / "procedure.yaml"
"""Below `configs/`: the plan of the policies that come with the product."""


@dataclass(frozen=True)
class Plan:
    """What is recorded, what is trained on what, and what is evaluated.

    Attributes:
        size: height and width of the images [px].
        encoder: the frozen encoder of every policy that names no other.
        pool: what is taken from it.
        recipe: the recipe of every policy that names no other.
        episodes: starts of each evaluation.
        demonstrations: what is recorded and rendered.
        policies: what is trained; the five subtasks and the high-level policy make up `suture`.
        seed: training seeds.
        conditions: the conditions of the evaluations.
        procedure: fields of `HierarchicalConfig` for the whole procedure.
        epochs: passes over the frames, of every policy; None takes the recipes'.
        env: fields of `TaskConfig` that differ from the default's, in every task: for recording
            and evaluation, except where demonstrations or conditions give a field themselves.
        starts: the bank of the evaluations' starts, one of `BANKS`.
        expert: evaluate the expert alongside the policies, in every condition.
        accept_licence: accept weights under a non-commercial licence.
        licence: the policies' licence, where they are released.
        not_run: rows that are listed but not run, with what they need.
    """

    size: int
    encoder: str
    pool: str
    recipe: str
    episodes: int
    demonstrations: tuple[Demonstrations, ...]
    policies: tuple[PlannedPolicy, ...]
    seed: tuple[int, ...] = (0,)
    conditions: tuple[Condition, ...] = (Condition(AS_TRAINED),)
    procedure: Mapping[str, JSON] = field(default_factory=dict)
    epochs: int | None = None
    env: Mapping[str, JSON] = field(default_factory=dict)
    starts: str = "test"
    expert: bool = False
    accept_licence: bool = False
    licence: str = "MIT"
    not_run: tuple[NotRun, ...] = ()

    def __post_init__(self) -> None:
        check_plan(self)

    def task_config(self, task: str, condition: Condition | None = None) -> TaskConfig:
        """Return the configuration of a task in the plan's env, or in that of a condition."""
        other = condition.env if condition else {}
        return from_mapping(TaskConfig, {**self.env, **other, "task": task}, "env")

    def recorded_env(self, recorded: Demonstrations, task: str | None = None) -> TaskConfig:
        """Return the env of demonstrations, by default with their own task."""
        fields = {**self.env, **recorded.env, "task": task or recorded.task}
        return from_mapping(TaskConfig, fields, "env")

    def evaluated_env(self, run: RunConfig, condition: Condition) -> Mapping[str, JSON]:
        """Return the fields of `TaskConfig` that an evaluation sets, whatever was trained on.

        An empty table keeps the env that the policies were trained in. So fields that only
        demonstrations change, including the looks they are rendered in, are set to the task's
        defaults. The whole procedure's step limit is left out: it is `HierarchicalConfig`'s.
        """
        plain = to_mapping(TaskConfig(run.task))
        own = [key for recorded in self.demonstrations for key in recorded.env]
        own += ["randomisation"] if any(each.looks for each in self.demonstrations) else []
        if run.is_hierarchical:
            own = [key for key in own if key != "max_steps"]
        theirs = {key: plain[key] for key in own}
        return {**theirs, **self.env, **condition.env}

    def recorded(self, policy: PlannedPolicy) -> Demonstrations:
        """Return what a policy is trained on."""
        return self._named(policy.demonstrations)

    def learned(self, recorded: Demonstrations) -> Demonstrations | None:
        """Return the demonstrations that a learner in `recorded` was trained on; else None."""
        return self.recorded(self.policy(recorded.learner)) if recorded.learner else None

    @functools.cached_property
    def learners(self) -> Mapping[str, Training]:
        """The policies that act in demonstrations, by the names of the datasets they act in."""
        return {
            _dataset_name(recorded, seed): self._training(self.policy(recorded.learner), seed)
            for seed in self.seed
            for recorded in self.demonstrations
            if recorded.learner
        }

    @property
    def evaluated_names(self) -> tuple[str, ...]:
        """Names of the policies that are evaluated by themselves where a condition names none."""
        return tuple(policy.name for policy in self._built if policy.acts)

    def _named(self, name: str) -> Demonstrations:
        return next(each for each in self.demonstrations if each.name == name)

    def dataset(self, recorded: Demonstrations, seed: int) -> DatasetConfig:
        """Return the dataset of demonstrations for a training seed."""
        built_on = {
            each.name: self.dataset(each, seed)
            for each in self.demonstrations
            if each.name in (recorded.visits_of, recorded.of)
        }
        first = self.learned(recorded)
        learned = self.dataset(first, seed) if first else None
        return DatasetConfig(
            self.recorded_env(recorded),
            recorded,
            self.size,
            first_seed=learned.next_seed if learned else first_seed(seed),
            visited=built_on.get(recorded.visits_of),
            multiplied=built_on.get(recorded.of),
            learned=learned,
        )

    def training(self, policy: PlannedPolicy, seed: int) -> RunConfig:
        """Return the training of a policy."""
        recorded = self.recorded(policy)
        lengths = ("epochs", BUDGET) if self.epochs else ()  # of the training, which the plan's is
        changes = tuple(
            change for change in policy.change if change.partition("=")[0] not in lengths
        )
        return RunConfig(
            self.recorded_env(recorded, policy.subtask),
            (policy.encoder or self.encoder) if policy.view else None,
            policy.view,
            policy=policy.policy,
            pool=(policy.pool or self.pool) if policy.view else "global",
            recipe=policy.recipe or self.recipe,
            changes=with_epochs(changes, self.epochs),
            demonstrations=None if recorded.visits_of or recorded.learner else recorded.episodes,
            demonstrator=recorded.demonstrator,
            noise=recorded.noise,
            post_success_steps=recorded.post_success_steps,
            frame_stride=recorded.frame_stride,
            variants=recorded.looks,
            multiplied_from=self._named(recorded.of).episodes if recorded.of else None,
            dagger_rounds=self._rounds(recorded),
            seed=seed,
        )

    @property
    def _built(self) -> tuple[PlannedPolicy, ...]:
        """The policies except those that only act in demonstrations."""
        learners = {recorded.learner for recorded in self.demonstrations}
        return tuple(policy for policy in self.policies if policy.name not in learners)

    def _rounds(self, recorded: Demonstrations) -> int:
        """Return how many learners there were, each trained on what the one before acted in."""
        first = self.learned(recorded)
        return 1 + self._rounds(first) if first else 0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of everything that is released, the whole procedure last."""
        built = tuple(policy.name for policy in self._built)
        return (*built, names.SUTURE) if len(self.suture) == len(PARTS) else built

    @functools.cached_property
    def suture(self) -> Mapping[str, PlannedPolicy]:
        """The policies of the whole procedure by their parts, as far as the plan has them."""
        named = {policy.name: policy for policy in self.policies if not policy.part}
        given = {policy.part: policy for policy in self.policies if policy.part}
        found = {**named, **given}
        return {part: found[part] for part in PARTS if part in found}

    def hierarchical(
        self, condition: Condition | None, parts: Mapping[str, str]
    ) -> HierarchicalConfig:
        """Return the whole procedure's policy in a condition.

        Args:
            condition: the condition; None takes the plan's own procedure.
            parts: name of each part → its folder; a part that is not given keeps its name.
        """
        everyone = {part: part for part in PARTS}
        other = condition.procedure if condition else {}
        table = {**everyone, **parts, **self.procedure, **other}
        return from_mapping(HierarchicalConfig, table, "procedure")

    @property
    def kind(self) -> str:
        """The key of `sweep.json` that it is stored under."""
        return "plan"

    @property
    def probe(self) -> bool:
        """Whether features are probed: never."""
        return False

    @property
    def runs(self) -> tuple[RunConfig, ...]:
        """Every policy in every condition, for one training seed after the other."""
        return (*self._evaluated, *self._listed)

    @functools.cached_property
    def _evaluated(self) -> dict[RunConfig, tuple[str, Condition]]:
        """Each run → the name of what is evaluated, and the condition."""
        return {run: (name, condition) for run, name, condition in self.evaluations()}

    def evaluations(self) -> Iterator[tuple[RunConfig, str, Condition]]:
        """Yield each run with the name of what is evaluated, and the condition."""
        evaluated = [*self.evaluated_names]
        evaluated += [names.SUTURE] if names.SUTURE in self.names else []
        for seed in self.seed:
            for condition in self.conditions:
                if condition.seed and seed not in condition.seed:
                    continue
                for name in condition.policies or evaluated:
                    yield self._run(name, condition, seed), name, condition

    @functools.cached_property
    def _listed(self) -> dict[RunConfig, str]:
        """Each run that is only listed → what it needs; in every condition without a shift."""
        return {
            RunConfig(
                self.task_config(task, condition),
                OWN,
                ("front",),
                policy=row.policy,
                starts=Starts(BANKS[self.starts], condition.episodes or self.episodes),
                condition=condition.name,
            ): row.needs
            for row in self.not_run
            for task in row.task
            for condition in self.conditions
            if condition.shift is None
        }

    def needs(self, run: RunConfig) -> str:
        """Return what a run needs that is not available; "" where it can be run."""
        return self._listed.get(run, "")

    def _run(self, name: str, condition: Condition, seed: int) -> RunConfig:
        """Return the evaluation of a policy, or of the whole procedure, in a condition."""
        episodes = condition.episodes or self.episodes
        starts = Starts(BANKS[self.starts], episodes)
        if name == names.SUTURE:
            seen = {view for policy in self.suture.values() for view in policy.view}
            return RunConfig(
                self.task_config(name, condition),
                views=tuple(view for view in view_names() if view in seen),
                seed=seed,
                termination=self.hierarchical(condition, {}).termination,
                parts=self._digest,
                starts=starts,
                shift=condition.shift,
                upset=condition.upset,
                detector=condition.detector,
                condition=condition.name,
            )
        training = self.training(self.policy(name), seed)
        env = self.task_config(training.task, condition)
        return replace(
            evaluated_in(training, env, condition.shift),
            starts=starts,
            upset=condition.upset,
            detector=condition.detector,
            condition=condition.name,
        )

    def policy(self, name: str) -> PlannedPolicy:
        """Return the policy of that name."""
        return next(policy for policy in self.policies if policy.name == name)

    @property
    def _digest(self) -> str:
        """Hash of what decides the whole procedure's policies, except the training seed."""
        table = {
            **to_mapping(self),
            "demonstrations": list(map(to_identity, self.demonstrations)),
        }
        decide = ("size", "encoder", "pool", "recipe", "demonstrations", "policies", "procedure")
        return digest({key: table[key] for key in (*decide, "epochs", "env")})

    @functools.cached_property
    def datasets(self) -> Mapping[str, DatasetConfig]:
        """The datasets of every training seed, by their folders' names."""
        return {
            _dataset_name(recorded, seed): self.dataset(recorded, seed)
            for seed in self.seed
            for recorded in self.demonstrations
        }

    def dataset_of(self, run: RunConfig) -> str:
        """Return the name of the dataset of a run's policy."""
        name, _ = self._evaluated[run]
        return _dataset_name(self.recorded(self.policy(name)), run.seed)

    def parts(self, run: RunConfig) -> Mapping[str, Training]:
        """Return the policies that a run evaluates, by their names."""
        if run in self._listed:
            return {}
        name, condition = self._evaluated[run]
        if name != names.SUTURE:
            return {name: self._training(self.policy(name), run.seed)}
        replaced = {**self.procedure, **condition.procedure}
        return {
            part: self._training(policy, run.seed)
            for part, policy in self.suture.items()
            if part not in replaced
        }

    def _training(self, policy: PlannedPolicy, seed: int) -> Training:
        dataset = _dataset_name(self.recorded(policy), seed)
        return Training(self.training(policy, seed), dataset, policy.subtask, encodes_all=False)

    def evaluated(self, run: RunConfig) -> Evaluated:
        """Return how a run is evaluated."""
        condition = next(each for each in self.conditions if each.name == run.condition)
        procedure = {**self.procedure, **condition.procedure}
        return Evaluated(self.evaluated_env(run, condition), procedure)

    def references(self, runs: Sequence[RunConfig]) -> tuple[RunConfig, ...]:
        """Return the expert on each task and condition of the runs, if the plan requests it."""
        found = {
            RunConfig(
                run.env,
                policy="expert",
                starts=run.starts,
                shift=run.shift,
                upset=run.upset,
                condition=run.condition,
            ): None
            for run in runs
            if self.expert and run not in self._listed
        }
        return tuple(found)

    def table(self) -> Mapping[str, JSON]:
        """Return the plan as plain data."""
        return to_mapping(self)

    def extends(self, stored: Mapping[str, JSON]) -> bool:
        """Return True if `stored` is this plan, but lacks some training seeds or conditions."""
        other = plan_of(stored, "the stored plan")
        return (
            to_mapping(replace(self, seed=other.seed, conditions=other.conditions))
            == to_mapping(other)
            and set(other.seed) <= set(self.seed)
            and all(condition in self.conditions for condition in other.conditions)
        )

    def smaller(
        self,
        demonstrations: int | None = None,
        epochs: int | None = None,
        episodes: int | None = None,
        size: int | None = None,
    ) -> "Plan":
        """Return the plan with other numbers, to try it in minutes; see `Experiment.smaller`."""
        recorded = self.demonstrations
        if demonstrations is not None:
            recorded = tuple(replace(each, episodes=demonstrations) for each in recorded)
        conditions = self.conditions
        if episodes is not None:
            conditions = tuple(replace(each, episodes=episodes) for each in conditions)
        return replace(
            self,
            demonstrations=recorded,
            conditions=conditions,
            epochs=self.epochs if epochs is None else epochs,
            episodes=self.episodes if episodes is None else episodes,
            size=self.size if size is None else size,
        )

    @property
    def text(self) -> str:
        """What is done, in words."""
        recorded = "; ".join(
            f"{each.episodes} demonstrations of {each.task} {each.manner}"
            for each in self.demonstrations
        )
        seen = {view for policy in self.policies for view in policy.view}
        views = ", ".join(view for view in view_names() if view in seen) or "no images"
        seeds = ", ".join(map(str, self.seed))
        return (
            f"for each training seed ({seeds}) its own {recorded}; {views} at {self.size} × "
            f"{self.size}; recipe {self.recipe}; {self.episodes} {self.starts} starts from "
            f"{BANKS[self.starts]}"
        )


def _dataset_name(recorded: Demonstrations, seed: int) -> str:
    return f"seed{seed}/{recorded.name}"


def plan_of(table: Mapping[str, object], where: str) -> Plan:
    """Build a plan from plain data; a single training seed may be given without brackets.

    Raises:
        InputError: a key or a value that is not allowed.
    """
    seed = table.get("seed")
    single = {"seed": [seed]} if isinstance(seed, int) else {}
    return from_mapping(Plan, {**table, **single}, where)


def read_plan(path: Path | None = None) -> Plan:
    """Read a plan, by default that of the policies that come with the product.

    Raises:
        BadFile: it cannot be read.
        InputError: a key or a value that is not allowed.
        UnknownName: its base is no shipped sweep.
    """
    path = path or configs_folder() / RELEASED_PLAN
    table = read_yaml(path)
    if BASE not in table:
        return plan_of(table, str(path))
    base = _base_file(str(table.pop(BASE)), path)
    below = read_yaml(base)
    if BASE in below:
        raise InputError(f"{path}: its base, {base}, has a base itself; name that one.")
    return plan_of({**below, **table}, str(path))


def is_plan(table: Mapping[str, object]) -> bool:
    """Return whether a file's table is a plan's, not a grid's."""
    return "policies" in table or BASE in table


def _base_file(base: str, path: Path) -> Path:
    """Return the file of a plan's base: a shipped plan's name, or a path from the plan's folder."""
    if Path(base).suffix:
        return path.parent / base
    shipped = {file.stem: file for file in (configs_folder() / "sweep").glob("*.yaml")}
    if base not in shipped:
        raise UnknownName("sweep", base, shipped)
    return shipped[base]
