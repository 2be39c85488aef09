"""Experiment: what a sweep does, as data.

Two kinds of file describe it: a grid (`grid.Grid`, `rl_grid.RLGrid`), every combination of its
axes; and a plan (`experiments.plan_config.Plan`), a set of policies rebuilt from scratch for
several training seeds and evaluated in several conditions.

An experiment consists of runs. A run either trains its policy on one of the datasets and evaluates
it, or evaluates policies that were trained before and that runs share (its parts).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError
from surgicai_vision.experiments.dataset_config import DatasetConfig
from surgicai_vision.training.run_config import RunConfig


@dataclass(frozen=True)
class Training:
    """A policy that runs share.

    Attributes:
        run: what is trained.
        dataset: name of the dataset it is trained on.
        subtask: train on this subtask's frames of whole procedures.
        encodes_all: encode every frame of the dataset, as other policies see them too; else only
            the subtask's.
    """

    run: RunConfig
    dataset: str
    subtask: str | None = None
    encodes_all: bool = True


@dataclass(frozen=True)
class Evaluated:
    """How a run is evaluated, where that differs from how its policies were trained.

    Attributes:
        env: fields of `TaskConfig`; empty keeps the env the policies were trained in.
        procedure: fields of `HierarchicalConfig`, for the whole procedure.
    """

    env: Mapping[str, JSON]
    procedure: Mapping[str, JSON]


class Experiment(Protocol):
    """What a sweep needs from its file."""

    @property
    def kind(self) -> str:
        """The key of `sweep.json` that it is stored under."""

    @property
    def runs(self) -> tuple[RunConfig, ...]:
        """Every run, each different, in the order in which they are done."""

    @property
    def datasets(self) -> Mapping[str, DatasetConfig]:
        """Name of each dataset (its folder below `data/`) → what it is."""

    @property
    def learners(self) -> Mapping[str, Training]:
        """Name of a dataset → the policy that acts in its demonstrations, trained before (DAgger).

        A dataset is missing where the demonstrator alone acts.
        """

    @property
    def accept_licence(self) -> bool:
        """Whether weights under a non-commercial licence are accepted."""

    @property
    def probe(self) -> bool:
        """Whether the features that runs see are probed for the needle's pose."""

    @property
    def text(self) -> str:
        """What is done, in words, for the report."""

    def dataset_of(self, run: RunConfig) -> str:
        """Return the name of the dataset that a run trains its own policy on, or replays."""

    def parts(self, run: RunConfig) -> Mapping[str, Training]:
        """Return the policies that a run evaluates, by their names; empty if it trains its own."""

    def needs(self, run: RunConfig) -> str:
        """Return what a run needs that no machine of ours has; "" where it can be run."""

    def evaluated(self, run: RunConfig) -> Evaluated:
        """Return how a run is evaluated."""

    def references(self, runs: Sequence[RunConfig]) -> tuple[RunConfig, ...]:
        """Return the untrained references that are evaluated alongside these runs."""

    def table(self) -> Mapping[str, JSON]:
        """Return the experiment as plain data."""

    def extends(self, stored: Mapping[str, JSON]) -> bool:
        """Return True if `stored`, an experiment of the same kind, may be continued as this one.

        Everything that it contains must be the same here.
        """

    def smaller(
        self,
        demonstrations: int | None = None,
        epochs: int | None = None,
        episodes: int | None = None,
        size: int | None = None,
    ) -> Self:
        """Return the experiment with other numbers, to try it in minutes.

        Runs that differ in nothing else become one.

        Args:
            demonstrations: of each dataset.
            epochs: passes over the frames, of every policy.
            episodes: starts of each evaluation.
            size: height and width of the images [px].
        """


def check_runs(runs: Sequence[RunConfig]) -> None:
    """Refuse a grid without runs, and one in which a run occurs twice.

    Raises:
        InputError: how many runs there are, and how many of them are different.
    """
    different = len(set(runs))
    if not runs or different != len(runs):
        raise InputError(
            f"The grid has {len(runs)} runs, {different} of them different; give at least one "
            "value of each axis, and each value once."
        )
