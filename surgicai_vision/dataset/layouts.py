"""Layouts: which columns a rendered dataset has, and what they are called.

* `surgicai`: ours, `dataset.schema`: increments of the active arm, and everything that the product
  trains, checks and evaluates with.
* `open-h`: the field's, `dataset.open_h`: both arms' absolute poses, for policies of others.

A layout says what is measured in every state that is rendered, what is taken from the
demonstration beside it, and in which order the columns enter the digest.
"""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, TaskConfig
from surgicai_vision.dataset import open_h, schema
from surgicai_vision.dataset.schema import Table
from surgicai_vision.demos.store import Demo

if TYPE_CHECKING:
    from surgicai_vision.envs.base import SuturingEnv

SURGICAI = "surgicai"
OPEN_H = "open-h"
type Measure = Callable[["SuturingEnv"], NDArray[np.float32]]


class Layout(Protocol):
    """What a dataset holds."""

    @property
    def views(self) -> tuple[str, ...]:
        """Views that are rendered where none are named."""

    @property
    def about(self) -> Mapping[str, JSON]:
        """What `meta/surgicai.json` says besides; `robot_type` is LeRobot's too."""

    @property
    def measured(self) -> Mapping[str, Measure]:
        """Column → what the env measures in the state that was set."""

    def image_keys(
        self, views: Sequence[str], depth: bool, segmentation: bool
    ) -> list[tuple[str, str, str]]:
        """Return (key, view, modality) of every image column, in the order of the digest."""

    def features(
        self, views: Sequence[str], size: int, depth: bool, segmentation: bool
    ) -> dict[str, Table]:
        """Return LeRobot's feature table."""

    def columns(self, views: Sequence[str]) -> tuple[str, ...]:
        """Return every column that is no image, in the order of the digest."""

    def recorded(
        self, demo: Demo, frame_stride: int, env: "SuturingEnv"
    ) -> dict[str, NDArray[np.generic]]:
        """Return the columns that are taken from the demonstration, (frames,) or (frames, n).

        `env` shows its states; it may be set to any.
        """

    def task_config(self, config: TaskConfig, frame_stride: int) -> TaskConfig:
        """Return the env in which a policy acts as the dataset's frames do."""


class SurgicaiLayout:
    """Our own columns; see `dataset.schema`."""

    views: tuple[str, ...] = ("front", "back")
    about: Mapping[str, JSON] = MappingProxyType({})
    measured: Mapping[str, Measure] = MappingProxyType(
        {
            names.STATE: lambda env: env.agent_pos(),
            names.NEEDLE_POSE: lambda env: env.needle_pose(),
            names.BOTH_ARMS: lambda env: env.both_arms(),
            names.SETPOINT: lambda env: env.setpoint(),
            names.PRIVILEGED_STATE: lambda env: env.state_vector(),
        }
    )

    def image_keys(
        self, views: Sequence[str], depth: bool, segmentation: bool
    ) -> list[tuple[str, str, str]]:
        """Return (key, view, modality) of every image column, in the order of the digest."""
        return schema.image_keys(views, depth, segmentation)

    def features(
        self, views: Sequence[str], size: int, depth: bool, segmentation: bool
    ) -> dict[str, Table]:
        """Return LeRobot's feature table."""
        return schema.features(views, size, depth, segmentation)

    def columns(self, views: Sequence[str]) -> tuple[str, ...]:
        """Return every column that is no image, in the order of the digest."""
        return schema.columns(views)

    def recorded(
        self, demo: Demo, frame_stride: int, env: "SuturingEnv"
    ) -> dict[str, NDArray[np.generic]]:
        """Return action, reward, success, contact, phase and seed; actions are those of a step."""
        return {names.ACTION: demo.action[::frame_stride], **schema.labels(demo, frame_stride)}

    def task_config(self, config: TaskConfig, frame_stride: int) -> TaskConfig:
        """Return the config as it is: whatever the stride, an action is that of one step."""
        return config


LAYOUTS: Mapping[str, Layout] = MappingProxyType(
    {SURGICAI: SurgicaiLayout(), OPEN_H: open_h.OpenHLayout()}
)
"""Layout name → what it is."""
