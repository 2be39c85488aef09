"""Grid: what a sweep's YAML file says, and the cells it stands for."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names, view_names
from surgicai_vision.core.config import (
    RandomisationConfig,
    TaskConfig,
    check_frame_stride,
    digest,
    to_mapping,
)
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.demos.demonstrator import SCRIPTED_DEMONSTRATORS
from surgicai_vision.demos.rollout import Disturbance
from surgicai_vision.evaluation.hierarchical import TERMINATIONS
from surgicai_vision.experiments.run import OWN, Cell
from surgicai_vision.experiments.sweep.lerobot import LEROBOT_POLICIES
from surgicai_vision.features import encoders
from surgicai_vision.training import policies

AXES = (
    "task",
    "encoder",
    "view",
    "recipe",
    "policy",
    "demonstrations",
    "seed",
    "chain",
)
"""Keys of a grid that hold lists; one value alone may be written without brackets."""


BANKS: Mapping[str, int] = MappingProxyType(
    {"test": names.TEST_SEED, "validation": names.VALIDATION_SEED}
)
"""Bank of start states → its first seed: what is chosen is chosen on validation, and told of
test.
"""


@dataclass(frozen=True)
class Ablation:
    """What is replaced in each cell that sees, alone and all else kept; what is None stays.

    Attributes:
        encoder, view, pool, recipe, change: a cell's.
        demonstrations: train on the first so many.
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
        if not self.replaced:
            raise InputError(
                "A ablation replaces nothing; give one of encoder, view, pool, recipe, change."
            )

    @property
    def replaced(self) -> dict[str, Any]:
        """Fields of a cell and their new values."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Grid:
    """A sweep's configuration: every combination of its axes, and what all cells share.

    Attributes:
        task: tasks.
        encoder: encoders; `own` for policies that train a network of their own on the images
            (`act`, `diffusion`).
        view: view sets, each a list of views.
        seed: training seeds.
        policy: policies: those of `train`, and LeRobot's `act` and `diffusion`.
        recipe: recipes of the former.
        pool: what is taken from the encoders.
        ablation: what is replaced one at a time in each cell that sees: ablations beside the whole.
        demonstrations: numbers of the expert's demonstrations of each task; the smaller set lies
            within the larger.
        demonstrator: who demonstrates: `expert`, or `search`, which does not know the goal of a
            grasp.
        noise: what they execute is disturbed by so much (`record-demos --noise`).
        post_success_steps: control steps that demonstrations go on after their success.
        randomisation: what differs from episode to episode besides the start, in demonstrations and
            evaluations.
        frame_stride: frames are rendered every so many steps; recipes must then take them so.
        chain: add, for the whole procedure, a high-level policy over a policy for each subtask, by
            how subtasks end: `privileged` or `learned`.
        swap: add each such chain with the expert in the place of each subtask's policy.
        accept_licence: accept weights under a non-commercial licence.
        proprioception: add a cell without images for each task and seed.
        state: add a cell that sees the state with the goal, the ceiling, for each task and seed.
        expert: evaluate the expert on each task beside the cells.
        replay: evaluate blind replay of the mean demonstration too.
        probe: probe the encoders' features for the needle's pose, where the command `probe` is
            there.
        epochs: passes over the frames; none takes the recipe's.
        steps: updates of LeRobot's policies.
        batch: their batch size.
        starts: the bank of the evaluation's starts, one of `BANKS`.
        episodes: starts of each evaluation.
        size: height and width of images [px].
        depth: render depth beside RGB; done by itself where a view is a depth view.
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
    chain: tuple[str, ...] = ()
    swap: bool = False
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
            check_name("policy", name, (*policies.policy_names(), *LEROBOT_POLICIES))
        check_name("demonstrator", self.demonstrator, SCRIPTED_DEMONSTRATORS)
        check_name("bank of starts", self.starts, BANKS)
        Disturbance(self.noise)  # refuses what is not within 0 and 1
        check_frame_stride(self.frame_stride)
        if self.post_success_steps < 0:
            raise InputError(
                f"post_success_steps is {self.post_success_steps}; it must be at least 0."
            )
        for name in self.chain:
            check_name("termination", name, TERMINATIONS)
        numbers = [(name, getattr(self, name)) for name in ("episodes", "size", "steps", "batch")]
        for name, number in [
            *numbers,
            *(("demonstrations", number) for number in self.demonstrations),
        ]:
            if number < 1:
                raise InputError(f"{name} is {number}; it must be at least 1.")
        if not self.demonstrations:
            raise InputError("demonstrations is empty; give at least one number.")
        for ablation in self.ablation:
            if (
                ablation.demonstrations is not None
                and not 1 <= ablation.demonstrations <= self.recorded
            ):
                raise InputError(
                    f"ablation: demonstrations is {ablation.demonstrations}; allowed: 1 to {self.recorded}."
                )
        if not self.cells or len(set(self.cells)) != len(self.cells):
            raise InputError(
                f"The grid has {len(self.cells)} cells, {len(set(self.cells))} of them different."
            )

    @property
    def cells(self) -> list[Cell]:
        """The cells, in the order of the grid."""
        cells: list[Cell] = []
        for task, seed, count in itertools.product(self.task, self.seed, self.demonstrations):
            common: dict[str, Any] = {"seed": seed, "epochs": self.epochs}
            if len(self.demonstrations) > 1:
                common["demonstrations"] = count
            for policy in self.policy:
                cells += self._of_policy(policy, task, common)
            if task == names.SUTURE:
                cells += self._chains(common)
        seeing = [cell for cell in cells if cell.encoder not in (None, OWN)]
        return cells + [
            replace(cell, **ablation.replaced) for cell in seeing for ablation in self.ablation
        ]

    def _of_policy(self, policy: str, task: str, common: dict[str, Any]) -> Iterator[Cell]:
        """Yield the cells of a policy on a task."""
        ours = policy not in LEROBOT_POLICIES
        recipes = self.recipe if ours else ("paper",)
        for encoder, view, recipe in itertools.product(self.encoder, self.view, recipes):
            if ours and encoder == OWN:
                continue  # `own` is for policies that see images themselves
            pool = self.pool if ours else "global"
            yield Cell(
                task,
                encoder,
                view,
                policy=policy,
                recipe=recipe,
                pool=pool,
                **common,
            )
        for recipe in recipes if ours else ():
            if self.proprioception:
                yield Cell(task, None, (), policy=policy, recipe=recipe, **common)
            if self.state:
                yield Cell(task, None, (), policy=policy, recipe=recipe, privileged=True, **common)

    def _chains(self, common: dict[str, Any]) -> Iterator[Cell]:
        """Yield the chains over the whole procedure."""
        encoders = [encoder for encoder in self.encoder if encoder != OWN]
        for end, encoder, view, recipe in itertools.product(
            self.chain, encoders, self.view, self.recipe
        ):
            whole = Cell(
                names.SUTURE, encoder, view, recipe=recipe, pool=self.pool, chain=end, **common
            )
            yield whole
            if self.swap:
                yield from (replace(whole, swap=subtask) for subtask in names.SUBTASKS)

    @property
    def views(self) -> tuple[str, ...]:
        """Every view some cell needs."""
        seen = {view for cell in self.cells for view in cell.view}
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
    def disturbance(self) -> Disturbance:
        """What disturbs the demonstrations."""
        return Disturbance(self.noise)

    @property
    def first_seed(self) -> int:
        """Seed of the first start of an evaluation."""
        return BANKS[self.starts]

    def config(self, task: str) -> TaskConfig:
        """Return the task as it is demonstrated and evaluated."""
        return TaskConfig(task, randomisation=self.randomisation)

    @property
    def recorded(self) -> int:
        """Demonstrations recorded of each task: the largest number; cells with fewer train on the
        first of them.
        """
        return max(self.demonstrations)

    def key(self, cell: Cell) -> str:
        """Return the digest of everything that decides what a cell is."""
        lerobot = (
            {"steps": self.steps, "batch": self.batch} if cell.policy in LEROBOT_POLICIES else {}
        )
        shared = {name: getattr(self, name) for name in ("episodes", "size", "depth")}
        shared |= {"views": list(self.views), "demonstrations": self.recorded, **lerobot}
        shared |= {
            "demonstrator": self.demonstrator,
            "noise": self.noise,
            **({"frame_stride": self.frame_stride} if self.frame_stride > 1 else {}),
        }
        shared |= {
            "post_success_steps": self.post_success_steps,
            "starts": self.starts,
            "randomisation": to_mapping(self.randomisation),
        }
        return digest({"cell": to_mapping(cell), **shared})[:16]


def chain_parts(cell: Cell) -> dict[str, Cell]:
    """Return the policies a chain is made of: "hlp" and those of its subtasks but for the one
    swapped.
    """
    alone = replace(cell, chain=None, swap=None)
    low = {
        subtask: replace(alone, task=subtask) for subtask in names.SUBTASKS if subtask != cell.swap
    }
    return {"hlp": replace(alone, policy="hlp"), **low}
