"""Grid: what a sweep's YAML file says, and the runs it stands for."""

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from surgicai_vision.core import names
from surgicai_vision.core.banks import BANKS
from surgicai_vision.core.cameras import camera_names, view_names
from surgicai_vision.core.config import (
    JSON,
    RandomisationConfig,
    TaskConfig,
    check_frame_stride,
    to_mapping,
)
from surgicai_vision.core.errors import InputError, check_at_least, check_name
from surgicai_vision.demos.demonstrator import SCRIPTED_DEMONSTRATORS
from surgicai_vision.demos.disturbance import Disturbance
from surgicai_vision.evaluation.hierarchical_config import HLP
from surgicai_vision.experiments.dataset_config import DatasetConfig, Demonstrations
from surgicai_vision.experiments.sweep.experiment import Evaluated, Training, check_runs
from surgicai_vision.features import encoders
from surgicai_vision.training import policies
from surgicai_vision.training.run_config import (
    LEROBOT_POLICIES,
    OWN,
    TERMINATIONS,
    RunConfig,
    Starts,
    of_training,
    with_epochs,
)

AXES: Mapping[str, Callable[[RunConfig], object]] = MappingProxyType(
    {
        "task": lambda run: run.task,
        "encoder": lambda run: run.encoder,
        "view": lambda run: run.views,
        "recipe": lambda run: run.recipe,
        "policy": lambda run: run.policy,
        "algo": lambda run: run.algo,
        "demonstrations": lambda run: run.demonstrations,
        "seed": lambda run: run.seed,
        "hierarchical": lambda run: run.termination,
    }
)
"""Keys of a grid that hold lists, and a run's value on each; a single value may be written without
brackets.
"""
HIGH_LEVEL: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("best", "endoscope", "unmoved"), "high-level")
)
"""Recipe of the low-level policies → the high-level policy's; any other recipe trains both, as the
paper's does.
"""


@dataclass(frozen=True)
class Ablation:
    """What is replaced in each run that sees, with all else kept; None replaces nothing.

    Attributes:
        encoder, view, pool, recipe: a run's.
        change: what else is changed in the recipe.
        demonstrations: train on this many, the first ones.
    """

    encoder: str | None = None
    view: tuple[str, ...] | None = None
    pool: str | None = None
    recipe: str | None = None
    change: tuple[str, ...] | None = None
    demonstrations: int | None = None

    def __post_init__(self) -> None:
        if self.encoder is not None:
            encoders.check_encoder_name(self.encoder)
        if all(value is None for value in vars(self).values()):
            raise InputError(
                "An ablation replaces nothing; give one of encoder, view, pool, recipe, change, "
                "demonstrations."
            )

    def of(self, run: RunConfig) -> RunConfig:
        """Return the run with this one thing replaced."""
        views = run.views if self.view is None else self.view
        if self.demonstrations is not None:
            run = replace(run, demonstrations=self.demonstrations)
        return replace(
            run,
            encoder=self.encoder or run.encoder,
            views=views,
            pool=self.pool or run.pool,
            recipe=self.recipe or run.recipe,
            changes=(*run.changes, *(self.change or ())),
        )


@dataclass(frozen=True)
class Grid:
    """A sweep's configuration: every combination of its axes, and what all runs share.

    Attributes:
        task: tasks.
        encoder: encoders; `own` for policies that train their own network on the images
            (`act`, `diffusion`).
        view: view sets, each a list of views.
        seed: training seeds.
        policy: policies: those of `train`, and LeRobot's `act` and `diffusion`.
        recipe: recipes of the policies of `train`.
        pool: what is taken from the encoders.
        ablation: what is replaced, one at a time, in copies of each run that sees.
        demonstrations: numbers of the demonstrations of each task; a smaller set is contained in a
            larger one.
        demonstrator: who demonstrates: `expert`, or `search`, which does not know the goal of a
            grasp.
        noise: noise on the actions they execute (`record-demos --noise`).
        post_success_steps: control steps that demonstrations go on after their success.
        randomisation: what differs from episode to episode besides the start, in demonstrations and
            evaluations.
        frame_stride: control steps from frame to frame; that of each recipe must be a multiple.
        hierarchical: for the whole procedure, add a high-level policy over one policy per subtask
            for each way in which subtasks may end: `privileged` or `learned`.
        expert_swap: also add each hierarchical policy with the expert in each subtask in turn.
        accept_licence: accept weights under a non-commercial licence.
        proprioception: add a run without images for each task and seed.
        state: add a run that sees the state with the goal, an upper bound, for each task and seed.
        expert: evaluate the expert on each task alongside the runs.
        replay: also evaluate a replay of the mean demonstration, which observes nothing.
        probe: probe the encoders' features for the needle's pose.
        epochs: passes over the frames; None takes the recipe's.
        steps: updates of LeRobot's policies.
        batch: batch size of LeRobot's policies.
        starts: the bank of the evaluation's starts, one of `BANKS`.
        episodes: starts of each evaluation.
        size: height and width of images [px].
        depth: render depth as well as RGB; automatic where a view is a depth view.
    """

    task: tuple[str, ...]
    encoder: tuple[str, ...]
    view: tuple[tuple[str, ...], ...]
    seed: tuple[int, ...] = (0,)
    policy: tuple[str, ...] = ("bc",)
    recipe: tuple[str, ...] = ("paper",)
    pool: str = "global"
    ablation: tuple[Ablation, ...] = ()
    demonstrations: tuple[int, ...] = (50,)
    demonstrator: str = "expert"
    noise: float = 0.0
    post_success_steps: int = 0
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)
    frame_stride: int = 1
    hierarchical: tuple[str, ...] = ()
    expert_swap: bool = False
    accept_licence: bool = False
    proprioception: bool = False
    state: bool = False
    expert: bool = True
    replay: bool = False
    probe: bool = False
    epochs: int | None = None
    steps: int = 2000
    batch: int = 8
    starts: str = "test"
    episodes: int = 20
    size: int = 224
    depth: bool = False

    def __post_init__(self) -> None:
        for name in self.encoder:
            if name != OWN:
                encoders.check_encoder_name(name)
        for name in self.policy:
            check_name("policy", name, policies.policy_names())
        check_name("demonstrator", self.demonstrator, SCRIPTED_DEMONSTRATORS)
        check_name("bank of starts", self.starts, BANKS)
        Disturbance(self.noise)  # refuses what is not within 0 and 1
        check_frame_stride(self.frame_stride)
        for name in self.hierarchical:
            check_name("termination", name, TERMINATIONS)
        self._check_numbers()
        check_runs(self.runs)
        if self.hierarchical and not any(run.is_hierarchical for run in self.runs):
            raise InputError(
                f"hierarchical adds no run here; it needs task: {names.SUTURE}, an encoder and "
                "views, or leave it out."
            )

    def _check_numbers(self) -> None:
        """Refuse numbers out of range."""
        check_at_least(0, post_success_steps=self.post_success_steps)
        if not self.demonstrations:
            raise InputError("demonstrations is empty; give at least one number.")
        check_at_least(
            1, episodes=self.episodes, size=self.size, steps=self.steps, batch=self.batch
        )
        check_at_least(1, demonstrations=min(self.demonstrations))
        for ablation in self.ablation:
            count = ablation.demonstrations
            if count is not None and not 1 <= count <= self.recorded:
                raise InputError(
                    f"ablation: demonstrations is {count}; allowed: 1 to {self.recorded}."
                )

    @functools.cached_property
    def runs(self) -> tuple[RunConfig, ...]:
        """The runs, in the order of the grid."""
        runs: list[RunConfig] = []
        for task, seed, count in itertools.product(self.task, self.seed, self.demonstrations):
            common = self._common(task, seed, count)
            for policy in self.policy:
                runs += self._of_policy(policy, common)
            if task == names.SUTURE:
                runs += self._hierarchical(common)
        seeing = [run for run in runs if run.encoder not in (None, OWN)]
        return (*runs, *(ablation.of(run) for run in seeing for ablation in self.ablation))

    def _common(self, task: str, seed: int, demonstrations: int) -> RunConfig:
        """Return a run with what all policies of a task share."""
        return RunConfig(
            self.config(task),
            changes=with_epochs((), self.epochs),
            demonstrations=demonstrations,
            demonstrator=self.demonstrator,
            noise=self.noise,
            post_success_steps=self.post_success_steps,
            frame_stride=self.frame_stride,
            seed=seed,
            starts=self.bank,
        )

    def _of_policy(self, policy: str, common: RunConfig) -> Iterator[RunConfig]:
        """Yield the runs of a policy on a task."""
        if policy in LEROBOT_POLICIES:
            common = replace(common, changes=(), updates=self.steps, batch_size=self.batch)
            for encoder, views in itertools.product(self.encoder, self.view):
                yield replace(common, policy=policy, encoder=encoder, views=views)
            return
        ours = replace(common, policy=policy)
        for encoder, views, recipe in itertools.product(self.encoder, self.view, self.recipe):
            if encoder != OWN:  # which is for policies that see the images themselves
                yield replace(ours, encoder=encoder, views=views, recipe=recipe, pool=self.pool)
        for recipe in self.recipe:
            if self.proprioception:
                yield replace(ours, recipe=recipe)
            if self.state:
                yield replace(ours, recipe=recipe, privileged=True)

    def _hierarchical(self, common: RunConfig) -> Iterator[RunConfig]:
        """Yield the hierarchical policies of the whole procedure."""
        frozen = [encoder for encoder in self.encoder if encoder != OWN]
        for termination, encoder, views, recipe in itertools.product(
            self.hierarchical, frozen, self.view, self.recipe
        ):
            whole = replace(
                common,
                encoder=encoder,
                views=views,
                recipe=recipe,
                pool=self.pool,
                termination=termination,
            )
            yield whole
            if self.expert_swap:
                yield from (replace(whole, expert_swap=subtask) for subtask in names.SUBTASKS)

    @property
    def views(self) -> tuple[str, ...]:
        """Every view some run needs."""
        seen = {view for run in self.runs for view in run.views}
        return tuple(view for view in view_names() if view in seen)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Every camera that is rendered."""
        needed = {names.camera_of(view) for view in self.views}
        return tuple(camera for camera in camera_names() if camera in needed)

    @property
    def has_depth(self) -> bool:
        """Whether depth is rendered."""
        return self.depth or any(map(names.is_depth_view, self.views))

    @property
    def bank(self) -> Starts:
        """Start states of every evaluation."""
        return Starts(BANKS[self.starts], self.episodes)

    def config(self, task: str) -> TaskConfig:
        """Return the task as it is demonstrated and evaluated."""
        return TaskConfig(task, randomisation=self.randomisation)

    @property
    def recorded(self) -> int:
        """Demonstrations recorded of each task: the largest number.

        Runs with fewer train on the first of them.
        """
        return max(self.demonstrations)

    @property
    def kind(self) -> str:
        """The key of `sweep.json` that it is stored under."""
        return "grid"

    @functools.cached_property
    def datasets(self) -> Mapping[str, DatasetConfig]:
        """Each task's dataset, by the task's name."""
        return {task: self._dataset(task) for task in self.task}

    @property
    def learners(self) -> Mapping[str, Training]:
        """No policy acts in the demonstrations."""
        return {}

    def _dataset(self, task: str) -> DatasetConfig:
        recorded = Demonstrations(
            task,
            task,
            self.recorded,
            self.cameras or ("front",),
            self.demonstrator,
            self.noise,
            self.post_success_steps,
            self.frame_stride,
        )
        return DatasetConfig(self.config(task), recorded, self.size, self.has_depth)

    def dataset_of(self, run: RunConfig) -> str:
        """Return the name of the dataset of a run: its task."""
        return run.task

    def parts(self, run: RunConfig) -> Mapping[str, Training]:
        """Return the policies of a hierarchical run, trained on frames of whole procedures."""
        if not run.is_hierarchical:
            return {}
        return {
            name: Training(
                replace(part, env=with_task(part.env, names.SUTURE)),
                run.task,
                None if part.task == names.SUTURE else part.task,
            )
            for name, part in parts_of(run).items()
        }

    def needs(self, run: RunConfig) -> str:
        """Return "": a grid lists nothing that it cannot run."""
        return ""

    def evaluated(self, run: RunConfig) -> Evaluated:
        """Return how a run is evaluated: in the env it was trained in."""
        return Evaluated({}, {"termination": run.termination} if run.is_hierarchical else {})

    def references(self, runs: Sequence[RunConfig]) -> tuple[RunConfig, ...]:
        """Return the expert and the replay on each task of the runs."""
        tasks = [task for task in self.task if any(run.task == task for run in runs)]
        wanted = (("expert", self.expert), ("replay", self.replay))
        return tuple(
            RunConfig(self.config(task), policy=name, starts=self.bank)
            for name, is_on in wanted
            if is_on
            for task in tasks
        )

    def table(self) -> Mapping[str, JSON]:
        """Return the grid as plain data."""
        return to_mapping(self)

    def extends(self, stored: Mapping[str, JSON]) -> bool:
        """Return True if `stored` is the same grid."""
        return self.table() == stored

    def smaller(
        self,
        demonstrations: int | None = None,
        epochs: int | None = None,
        episodes: int | None = None,
        size: int | None = None,
    ) -> "Grid":
        """Return the grid with other numbers, to try it in minutes; see `Experiment.smaller`."""
        ablations = self.ablation
        if demonstrations is not None:  # all runs have this number, so none can replace it
            ablations = tuple(each for each in ablations if each.demonstrations is None)
        return replace(
            self,
            demonstrations=self.demonstrations if demonstrations is None else (demonstrations,),
            ablation=ablations,
            epochs=self.epochs if epochs is None else epochs,
            episodes=self.episodes if episodes is None else episodes,
            size=self.size if size is None else size,
        )

    @property
    def text(self) -> str:
        """What is done, in words."""
        counts = ", ".join(map(str, self.demonstrations))
        manner = self._dataset(self.task[0]).demonstrations.manner
        world = self.randomisation.text
        varies = f", in a world that varies ({world})" if world else ""
        data = f"{counts} demonstrations of each task {manner}{varies}"
        seen = (
            f"{', '.join(self.views)} at {self.size} × {self.size}" if self.views else "no images"
        )
        taught = f"{', '.join(self.policy)}, recipe {', '.join(self.recipe)}"
        starts = f"{self.episodes} {self.starts} starts from {self.bank.first_seed}"
        return "; ".join([data, seen, taught, starts])


def parts_of(run: RunConfig) -> dict[str, RunConfig]:
    """Return the policies of a hierarchical run: `HLP`, and each subtask's except the one swapped.

    The high-level policy has its own recipe where `HIGH_LEVEL` names one.
    """
    alone = replace(of_training(run), termination=None)
    low = {
        subtask: replace(alone, env=with_task(run.env, subtask))
        for subtask in names.SUBTASKS
        if subtask != run.expert_swap
    }
    recipe = HIGH_LEVEL.get(run.recipe, run.recipe)
    return {HLP: replace(alone, policy=HLP, recipe=recipe), **low}


def with_task(config: TaskConfig, task: str) -> TaskConfig:
    """Return another task in the same scene, with that task's limit of steps."""
    return replace(config, task=task, max_steps=0)
