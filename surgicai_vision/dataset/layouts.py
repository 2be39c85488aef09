"""Layouts: which columns a rendered dataset has, and their names.

* `surgicai`: ours, `dataset.schema`: increments of the active arm, and everything that the product
  trains, checks and evaluates with.
* `open-h`: the field's, `dataset.open_h`: both arms' absolute poses, for other people's policies.

A layout defines what is measured in every rendered state, what is taken from the demonstration,
and in which order the columns enter the digest.
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
        """Views that are rendered if none are named."""

    @property
    def about(self) -> Mapping[str, JSON]:
        """Additional entries of `meta/surgicai.json`; `robot_type` is also LeRobot's."""

    @property
    def measured(self) -> Mapping[str, Measure]:
        """Column → what the env measures in the state it was set to."""

    def image_keys(
        self, views: Sequence[str], depth: bool, segmentation: bool
    ) -> list[tuple[str, str, str]]:
        """Return (key, view, modality) of every image column, in the order of the digest."""

    def features(
        self, views: Sequence[str], size: int, depth: bool, segmentation: bool
    ) -> dict[str, Table]:
        """Return LeRobot's feature table."""

    def columns(self, views: Sequence[str]) -> tuple[str, ...]:
        """Return every column that is not an image, in the order of the digest."""

    def recorded(
        self, demo: Demo, frame_stride: int, env: "SuturingEnv"
    ) -> dict[str, NDArray[np.generic]]:
        """Return the columns that are taken from the demonstration, (frames,) or (frames, n).

        `env` can show the demonstration's states and may be set to any state.
        """

    def task_config(self, config: TaskConfig, frame_stride: int) -> TaskConfig:
        """Return the config of the env in which a policy's actions mean what the dataset's do.

        Raises:
            InputError: a frame stride that the layout does not support with this config.
        """


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
        """Return every column that is not an image, in the order of the digest."""
        return schema.columns(views)

    def recorded(
        self, demo: Demo, frame_stride: int, env: "SuturingEnv"
    ) -> dict[str, NDArray[np.generic]]:
        """Return action and labels (reward, success, phase, …); an action is that of one step."""
        return {names.ACTION: demo.action[::frame_stride], **schema.labels(demo, frame_stride)}

    def task_config(self, config: TaskConfig, frame_stride: int) -> TaskConfig:
        """Return the config unchanged: whatever the stride, an action is that of one step.

        Raises:
            InputError: the frames' spacing does not divide a second.
        """
        schema.check_spacing(frame_stride, config.action_repeat)
        return config


LAYOUTS: Mapping[str, Layout] = MappingProxyType(
    {SURGICAI: SurgicaiLayout(), OPEN_H: open_h.OpenHLayout()}
)
"""Layout name → layout."""
