"""Grid of reinforcement and offline learning: what a sweep's YAML file with `algo` says.

Every combination of task, algorithm, number of demonstrations and training seed is a run: an actor
on the state, trained by `rl.train` and evaluated from the starts of a bank. Demonstrations are
recorded once per task and not rendered; a run with fewer takes the first of them.

    task: [grasp, handoff]
    algo: [td3-her-bc, rlpd]
    demonstrations: [100]
    noise: 0.5
    env_steps: 50000                  # online; `updates` offline
    change:                           # settings of an algorithm or a task, as `train --change`
      rlpd: ["critics=4"]
    hierarchical: true                # the whole procedure, over the actors of each algorithm
    decisions: 1500                   # of PPO as its high-level policy (Table 3)

An algorithm that learns from no demonstrations has one run per task and seed, whatever their
numbers. Light to import: no library of reinforcement learning.
"""

import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from surgicai_vision.core import names
from surgicai_vision.core.banks import BANKS
from surgicai_vision.core.config import JSON, TaskConfig, from_mapping, read_changes, to_mapping
from surgicai_vision.core.errors import InputError, check_at_least, check_at_most, check_name
from surgicai_vision.demos.disturbance import Disturbance
from surgicai_vision.experiments.dataset_config import DatasetConfig, Demonstrations
from surgicai_vision.experiments.sweep.experiment import Evaluated, Training, check_runs
from surgicai_vision.rl.algorithms import ALGORITHMS
from surgicai_vision.rl.high_level_config import DECISIONS
from surgicai_vision.rl.settings import LARGEST_SEED, OBSERVATIONS, settings_of
from surgicai_vision.training.run_config import RunConfig, Starts

RECIPE = "rl"
"""`RunConfig.recipe` of an actor; no file."""


@dataclass(frozen=True)
class RLGrid:
    """A sweep over algorithms; see the module's docstring.

    Attributes:
        task: subtasks.
        algo: keys of `rl.algorithms.ALGORITHMS`.
        seed: training seeds.
        demonstrations: how many are learned from; a smaller set is contained in a larger one.
        noise: noise on the actions that the demonstrating expert executes.
        observation: what the actors see of the state, "relative" or "state".
        env_steps: control steps of online algorithms.
        updates: updates of offline algorithms.
        change: algorithm, or task → settings that are changed for it, "key=value" each; a task's
            come after an algorithm's, and every algorithm must read them.
        env: fields of `TaskConfig` for demonstrations, training and evaluation alike.
        validation: episodes of each evaluation during training, from validation starts.
        save_every: control steps (offline: updates) between these evaluations, and between the
            states that a killed training resumes from.
        hierarchical: add, for each algorithm, number of demonstrations and seed, the whole
            procedure by PPO over the actors of that seed; needs all five subtasks.
        decisions: decisions that PPO learns from.
        starts: the bank of the evaluation's starts, one of `BANKS`.
        episodes: starts of each evaluation.
        expert: evaluate the expert on each task alongside the runs.
    """

    task: tuple[str, ...]
    algo: tuple[str, ...]
    seed: tuple[int, ...] = (0,)
    demonstrations: tuple[int, ...] = (100,)
    noise: float = 0.5
    observation: str = "relative"
    env_steps: int = 50_000
    updates: int = 10_000
    change: Mapping[str, JSON] = field(default_factory=dict)
    env: Mapping[str, JSON] = field(default_factory=dict)
    validation: int = 20
    save_every: int = 5000
    hierarchical: bool = False
    decisions: int = DECISIONS
    starts: str = "test"
    episodes: int = 100
    expert: bool = False

    def __post_init__(self) -> None:
        for task in self.task:
            check_name("subtask", task, names.SUBTASKS)
        for algo in self.algo:
            check_name("algo", algo, ALGORITHMS)
        for key in self.change:
            check_name("algo or subtask", key, (*ALGORITHMS, *names.SUBTASKS))
        for algo, task in itertools.product(self.algo, self.task):
            settings_of(algo, read_changes(self._changes(algo, task)))  # refuses what is not read
        if "task" in self.env:
            raise InputError("env has 'task', which is an axis of its own; leave it out of env.")
        check_name("observation", self.observation, OBSERVATIONS)
        check_name("bank of starts", self.starts, BANKS)
        Disturbance(self.noise)  # refuses what is not within 0 and 1
        check_at_least(
            1,
            env_steps=self.env_steps,
            updates=self.updates,
            save_every=self.save_every,
            decisions=self.decisions,
            episodes=self.episodes,
            demonstrations=min(self.demonstrations, default=None),
        )
        check_at_least(0, validation=self.validation)
        check_at_most(LARGEST_SEED, seed=max(self.seed, default=0))
        if self.hierarchical and set(self.task) != set(names.SUBTASKS):
            raise InputError(
                f"hierarchical needs all of {', '.join(names.SUBTASKS)}; task is "
                f"{', '.join(self.task)}."
            )
        check_runs(self.runs)

    def _changes(self, algo: str, task: str) -> tuple[str, ...]:
        """Return the changed settings of an algorithm on a task."""
        return (*self._changes_of(algo), *self._changes_of(task))

    def _changes_of(self, key: str) -> tuple[str, ...]:
        """Return what `change` has for an algorithm or a task."""
        changes = self.change.get(key, ())
        if not isinstance(changes, list | tuple):
            raise InputError(f"change of '{key}' is {changes!r}; give a list of KEY=VALUE.")
        return tuple(map(str, changes))

    @functools.cached_property
    def runs(self) -> tuple[RunConfig, ...]:
        """The runs, in the order of the grid; whole procedures last."""
        return (*self._actors(), *self._procedures())

    def _actors(self) -> Iterator[RunConfig]:
        """Yield a run for each algorithm, task, number of demonstrations and seed."""
        axes = (self.algo, self.task, self.demonstrations, self.seed)
        yield from dict.fromkeys(
            self._actor(algo, task, count, seed)
            for algo, task, count, seed in itertools.product(*axes)
        )

    def _actor(self, algo: str, task: str, demonstrations: int, seed: int) -> RunConfig:
        algorithm = ALGORITHMS[algo]
        learns = algorithm.needs_demos
        return RunConfig(
            self.config(task),
            policy=algorithm.policy,
            privileged=self.observation == "state",
            recipe=RECIPE,
            changes=self._changes(algo, task),
            demonstrations=demonstrations if learns else None,
            demonstrator="expert" if learns else None,
            noise=self.noise if learns else 0.0,
            updates=None if algorithm.is_online else self.updates,
            seed=seed,
            algo=algo,
            env_steps=self.env_steps if algorithm.is_online else 0,
            starts=self.bank,
        )

    def _procedures(self) -> Iterator[RunConfig]:
        """Yield the whole procedure over the actors of each algorithm and seed."""
        if not self.hierarchical:
            return
        axes = (self.algo, self.demonstrations, self.seed)
        yield from dict.fromkeys(
            replace(
                self._actor(algo, names.SUBTASKS[0], count, seed),
                env=self.config(names.SUTURE),
                changes=self._changes_of(algo),
                termination="privileged",
            )
            for algo, count, seed in itertools.product(*axes)
        )

    @property
    def bank(self) -> Starts:
        """Start states of every evaluation."""
        return Starts(BANKS[self.starts], self.episodes)

    def config(self, task: str) -> TaskConfig:
        """Return the task as it is demonstrated, learned and evaluated."""
        return from_mapping(TaskConfig, {**self.env, "task": task}, "env")

    @property
    def kind(self) -> str:
        """The key of `sweep.json` that it is stored under."""
        return "rl_grid"

    @functools.cached_property
    def datasets(self) -> Mapping[str, DatasetConfig]:
        """Each task's demonstrations, by the task's name; no images are rendered."""
        return {
            task: DatasetConfig(
                self.config(task),
                Demonstrations(
                    task,
                    task,
                    max(self.demonstrations),
                    (),
                    noise=self.noise,
                    post_success_steps=self._post_success_steps(task),
                    frame_stride=1,
                ),
            )
            for task in self.task
        }

    def _post_success_steps(self, task: str) -> int:
        """Return the control steps recorded after a success: twice those it must hold, if any."""
        changed = (settings_of(algo, read_changes(self._changes(algo, task))) for algo in self.algo)
        most = max(settings.success_steps for settings in changed)
        return 2 * most if most > 1 else 0

    @property
    def accept_licence(self) -> bool:
        """Return False: no third-party weights are used."""
        return False

    @property
    def learners(self) -> Mapping[str, Training]:
        """No policy acts in the demonstrations."""
        return {}

    @property
    def probe(self) -> bool:
        """Return False: there are no features."""
        return False

    def dataset_of(self, run: RunConfig) -> str:
        """Return the name of the demonstrations of a run: its task."""
        return run.task

    def parts(self, run: RunConfig) -> Mapping[str, Training]:
        """Return the actors of a run, trained once: procedures and rows of actors share them."""
        if not self.hierarchical:
            return {}
        assert run.algo is not None
        algo, count, seed = run.algo, run.demonstrations or 0, run.seed
        tasks = names.SUBTASKS if run.is_hierarchical else (run.task,)
        actors = {task: self._actor(algo, task, count, seed) for task in tasks}
        return {task: Training(replace(actor, starts=None), task) for task, actor in actors.items()}

    def needs(self, run: RunConfig) -> str:
        """Return "": a grid lists nothing that it cannot run."""
        return ""

    def evaluated(self, run: RunConfig) -> Evaluated:
        """Return how a run is evaluated: in the env it was trained in."""
        return Evaluated({}, {"termination": run.termination} if run.is_hierarchical else {})

    def references(self, runs: Sequence[RunConfig]) -> tuple[RunConfig, ...]:
        """Return the expert on each task of the runs."""
        tasks = dict.fromkeys(run.task for run in runs) if self.expert else ()
        return tuple(
            RunConfig(self.config(task), policy="expert", starts=self.bank) for task in tasks
        )

    def table(self) -> Mapping[str, JSON]:
        """Return the grid as plain data."""
        return to_mapping(self)

    def extends(self, stored: Mapping[str, JSON]) -> bool:
        """Return True if `stored` is the same except for tasks, algorithms and seeds added here."""
        axes = ("task", "algo", "seed")
        mine = self.table()
        rest = {name: value for name, value in mine.items() if name not in axes}
        if rest != {name: value for name, value in stored.items() if name not in axes}:
            return False
        return all(_within(stored[name], mine[name]) for name in axes)

    def smaller(
        self,
        demonstrations: int | None = None,
        epochs: int | None = None,
        episodes: int | None = None,
        size: int | None = None,
    ) -> "RLGrid":
        """Return the grid with other numbers; it has no `epochs` and no `size`."""
        for name, value in (("epochs", epochs), ("size", size)):
            if value is not None:
                raise InputError(f"A sweep over algorithms has no {name}; leave --{name} out.")
        return replace(
            self,
            demonstrations=self.demonstrations if demonstrations is None else (demonstrations,),
            episodes=self.episodes if episodes is None else episodes,
        )

    @property
    def text(self) -> str:
        """What is done, in words."""
        manner = self.datasets[self.task[0]].demonstrations.manner
        kinds = [ALGORITHMS[algo] for algo in self.algo]
        parts = []
        if any(kind.needs_demos for kind in kinds):
            counts = ", ".join(map(str, self.demonstrations))
            parts.append(f"{counts} demonstrations of each task {manner}")
        if any(kind.is_online for kind in kinds):
            parts.append(f"{self.env_steps:,} control steps online")
        if not all(kind.is_online for kind in kinds):
            parts.append(f"{self.updates:,} updates offline")
        changed = [
            f"{key} with {', '.join(self._changes_of(key))}"
            for key in (*self.algo, *self.task)
            if self._changes_of(key)
        ]
        starts = f"{self.episodes} {self.starts} starts from {self.bank.first_seed}"
        return "; ".join([*parts, f"observation {self.observation}", *changed, starts])


def _within(stored: JSON, mine: JSON) -> bool:
    """Return True if every value of a stored axis is in mine."""
    assert isinstance(stored, list) and isinstance(mine, list)
    return all(value in mine for value in stored)
