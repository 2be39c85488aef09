"""What a release consists of, as data; light to import, for the command line.

`configs/release.yaml` is the plan of the policies that come with the product.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import yaml

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, check_name
from surgicai_vision.core.files import configs_folder
from surgicai_vision.training.run_config import RunConfig, with_epochs

HLP = "hlp"
"""Name of the high-level policy."""


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations that policies are trained on, and the images rendered of them.

    Attributes:
        name: how the policies' `demonstrations` call them.
        task: the task that is demonstrated.
        episodes: how many.
        view: rendered views.
        demonstrator: who demonstrates.
        noise: how much what the demonstrator executes is disturbed.
        post_success_steps: control steps an episode goes on after its success.
        frame_stride: control steps from frame to frame.
    """

    name: str
    task: str
    episodes: int
    view: tuple[str, ...]
    demonstrator: str = "expert"
    noise: float = 0.6
    post_success_steps: int = 0
    frame_stride: int = 5


@dataclass(frozen=True)
class ReleasedPolicy:
    """A policy of the release.

    Attributes:
        name: its name, without "released:".
        demonstrations: name of what it is trained on.
        subtask: take one subtask's frames of whole procedures.
        view: what it sees; nothing for proprioception alone.
        policy: its kind.
    """

    name: str
    demonstrations: str
    subtask: str | None = None
    view: tuple[str, ...] = ()
    policy: str = "bc"


@dataclass(frozen=True)
class ReleasePlan:
    """Everything that decides what is released.

    Attributes:
        licence: the policies' licence.
        size: height and width of the images [px].
        encoder: the frozen encoder of all.
        pool: what is taken from it.
        recipe: the recipe of all.
        seed: training seed.
        episodes: held-out starts of each evaluation.
        demonstrations: what is recorded and rendered.
        policies: what is trained; the five subtasks and the high-level policy make `suture`.
        procedure: when a subtask of the whole procedure ends, as `HierarchicalConfig` has it.
        epochs: passes over the frames; None takes the recipe's.
        env: fields of `TaskConfig` that differ from the default's, in every task.
    """

    licence: str
    size: int
    encoder: str
    pool: str
    recipe: str
    seed: int
    episodes: int
    demonstrations: tuple[Demonstrations, ...]
    policies: tuple[ReleasedPolicy, ...]
    procedure: Mapping[str, JSON] = field(default_factory=dict)
    epochs: int | None = None
    env: Mapping[str, JSON] = field(default_factory=dict)

    def __post_init__(self) -> None:
        known = [recorded.name for recorded in self.demonstrations]
        for recorded in self.demonstrations:
            self.task_config(recorded.task)
        for policy in self.policies:
            check_name("demonstrations", policy.demonstrations, known)
            recorded = self.recorded(policy)
            for view in policy.view:
                check_name("rendered view", view, recorded.view)

    def task_config(self, task: str) -> TaskConfig:
        """Return the configuration of a task in the plan's env."""
        return from_mapping(TaskConfig, {**self.env, "task": task}, "env")

    def recorded(self, policy: ReleasedPolicy) -> Demonstrations:
        """Return what a policy is trained on."""
        return next(each for each in self.demonstrations if each.name == policy.demonstrations)

    def run(self, policy: ReleasedPolicy) -> RunConfig:
        """Return the training of a policy."""
        recorded = self.recorded(policy)
        return RunConfig(
            self.task_config(policy.subtask or recorded.task),
            self.encoder if policy.view else None,
            policy.view,
            policy=policy.policy,
            pool=self.pool if policy.view else "global",
            recipe=self.recipe,
            changes=with_epochs((), self.epochs),
            demonstrations=recorded.episodes,
            demonstrator=recorded.demonstrator,
            noise=recorded.noise,
            post_success_steps=recorded.post_success_steps,
            frame_stride=recorded.frame_stride,
            seed=self.seed,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of everything that is released, the whole procedure last."""
        parts = tuple(policy.name for policy in self.policies)
        whole = {*names.SUBTASKS, HLP} <= set(parts)
        return (*parts, names.SUTURE) if whole else parts


def read_plan(path: Path | None = None) -> ReleasePlan:
    """Read a plan, by default `configs/release.yaml`.

    Raises:
        BadFile: it cannot be read.
        InputError: a key or a value that is not allowed.
    """
    path = path or configs_folder() / "release.yaml"
    try:
        table = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise BadFile(f"Cannot read {path}: {' '.join(str(error).split())}.") from None
    return from_mapping(ReleasePlan, table or {}, str(path))


def smaller(
    plan: ReleasePlan,
    *,
    demonstrations: int | None = None,
    epochs: int | None = None,
    episodes: int | None = None,
    size: int | None = None,
) -> ReleasePlan:
    """Return a plan with other numbers, to try the command in minutes.

    Args:
        plan: the plan.
        demonstrations: of each kind.
        epochs: passes over the frames.
        episodes: held-out starts of each evaluation.
        size: height and width of the images [px].

    Raises:
        InputError: a number below 1.
    """
    given = {
        "demonstrations": demonstrations,
        "epochs": epochs,
        "episodes": episodes,
        "size": size,
    }
    for name, number in given.items():
        if number is not None and number < 1:
            raise InputError(f"{name} is {number}; it must be at least 1.")
    recorded = tuple(
        replace(each, episodes=demonstrations or each.episodes) for each in plan.demonstrations
    )
    return replace(
        plan,
        demonstrations=recorded,
        epochs=epochs or plan.epochs,
        episodes=episodes or plan.episodes,
        size=size or plan.size,
    )
