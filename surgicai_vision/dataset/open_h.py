"""The layout of Open-H-Embodiment, in which the field publishes its dVRK data.

    surgicai-vision render-demos --task suture --layout open-h

| column | content |
|---|---|
| `observation.images.endoscope.left`, `….right` | the two eyes of the endoscope |
| `observation.images.wrist.left`, `….right` | the wrist cameras of PSM2 and of PSM1 |
| `observation.state` (16,) | both arms' measured poses and jaws (`envs.absolute.measured`) |
| `action` (16,) | the set-points that they receive next (`envs.absolute.setpoints`) |
| `instruction.text` | the subtask in words, per frame |
| `needle_pose`, `phase`, `seed`, `contact`, `next.*`, `calibration.*` | ours, as in `schema` |

`robot_type` is `dvrk`; `task` is the whole task in words.

Sources: names, order, shapes and `names` of features (one list within a list) are from
`scripts/conversion/dvrk_zarr_to_lerobot.py` of github.com/open-h/open-h-embodiment; this layout is
its LeRobot v3 form. There, `wrist.left` is PSM2's, and `psm1_pose`, `psm1_sp`, `psm1_jaw` and
`psm1_jaw_sp` are recorded from `/PSM1/measured_cp`, `/PSM1/setpoint_cp`, `/PSM1/jaw/measured_js`
and `/PSM1/jaw/setpoint_js`. The first public datasets (Open-H-Embodiment v1, SutureBot, SutureBot2)
are LeRobot v2.1 with the same columns.

Differences: keys follow the arm, and our PSM2 is on the right of the endoscope's image, as in
SurgicAI, whereas a dVRK's is usually on the left. Images are square. The names of our own columns
do not mark them as observations, so no policy receives them. The original's texts
`observation.meta.tool.psm1` and `….psm2` are in `meta/surgicai.json` as `instruments`: LeRobot
0.6.1 treats every column called `observation.…` as numeric input of a policy, and its training
fails on a text ("too many dimensions 'str'").

An action is the commanded pose of the arms when the next frame is taken. With a frame stride, it is
therefore held for that many control steps; `task_config` sets `action_repeat` accordingly. It is
what was executed, so demonstrations with other labels (noise, upsets, a learner) are refused.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import ACTION_REPEAT_LIMIT, JSON, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.tasks import task_text
from surgicai_vision.dataset import schema
from surgicai_vision.dataset.schema import Table
from surgicai_vision.demos.store import Demo

if TYPE_CHECKING:
    from surgicai_vision.envs.base import SuturingEnv

IMAGES: Mapping[str, str] = MappingProxyType(
    {
        "endo_left": "endoscope.left",
        "endo_right": "endoscope.right",
        "wrist_psm2": "wrist.left",
        "wrist_psm1": "wrist.right",
    }
)
"""View → its name in an image key after `observation.images.`; other views keep their names."""
INSTRUCTION = "instruction.text"
INSTRUMENT = "Large Needle Driver"
"""Both arms' instrument: 400006 and 420006 are Large Needle Drivers (a dVRK's tool files)."""
VECTORS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        names.STATE: names.ABSOLUTE_STATE_NAMES,
        names.ACTION: names.ABSOLUTE_ACTION_NAMES,
    }
)
"""float32 columns of the layout → names of their elements."""


def image_name(view: str) -> str:
    """Return a view's name in the layout."""
    return IMAGES.get(view, view)


def image_key(view: str) -> str:
    """Return the LeRobot feature key of a view's image."""
    return names.image_key(image_name(view))


class OpenHLayout:
    """The columns of Open-H-Embodiment; see the module's docstring."""

    views: tuple[str, ...] = tuple(IMAGES)
    about: Mapping[str, JSON] = MappingProxyType(
        {
            "robot_type": "dvrk",
            "frame": "ECM_view",
            "instruments": dict.fromkeys(names.ARMS, INSTRUMENT),
        }
    )
    measured: "Mapping[str, Callable[[SuturingEnv], NDArray[np.float32]]]" = MappingProxyType(
        {
            names.STATE: lambda env: env.absolute_pos(),
            names.NEEDLE_POSE: lambda env: env.needle_pose(),
        }
    )

    def image_keys(
        self, views: Sequence[str], depth: bool, segmentation: bool
    ) -> list[tuple[str, str, str]]:
        """Return (key, view, modality) of every image column, in the order of the digest."""
        shown = [image_name(view) for view in views]
        own = dict(zip(shown, views, strict=True))
        keys = schema.image_keys(shown, depth, segmentation)
        return [(key, own[name], modality) for key, name, modality in keys]

    def features(
        self, views: Sequence[str], size: int, depth: bool, segmentation: bool
    ) -> dict[str, Table]:
        """Return LeRobot's feature table."""
        table = schema.image_features(self.image_keys(views, depth, segmentation), size)
        for key, elements in VECTORS.items():
            table[key] = {"dtype": "float32", "shape": (16,), "names": [list(elements)]}
        table[INSTRUCTION] = {"dtype": "string", "shape": (1,), "names": ["instruction"]}
        own = schema.features(views, size, False, False)
        return table | {key: own[key] for key in self.columns(views) if key not in table}

    def columns(self, views: Sequence[str]) -> tuple[str, ...]:
        """Return every column that is not an image, in the order of the digest."""
        own = (names.NEEDLE_POSE, *schema.SCALARS, *schema.calibration_keys(views))
        return (*VECTORS, INSTRUCTION, *own)

    def recorded(
        self, demo: Demo, frame_stride: int, env: "SuturingEnv"
    ) -> dict[str, NDArray[np.generic]]:
        """Return set-points, texts and labels; reward, success and contact: at the frame's end."""
        from surgicai_vision.envs.absolute import setpoints  # only rendering needs MuJoCo

        steps = np.arange(0, len(demo), frame_stride)
        ends = np.minimum(steps + frame_stride, len(demo))
        actions = []
        for end in ends:
            env.set_state_vector(demo.state[end])
            actions.append(setpoints(env.simulation))
        phases = demo.phase[steps].tolist()
        texts = [instruction(demo.config.task, phase) for phase in phases]
        last = ends - 1
        return {
            **schema.labels(demo, frame_stride),
            names.REWARD: demo.reward[last],
            names.SUCCESS: demo.success[last],
            names.CONTACT: demo.contact[last],
            names.ACTION: np.stack(actions),
            INSTRUCTION: np.array(texts),
        }

    def task_config(self, config: TaskConfig, frame_stride: int) -> TaskConfig:
        """Return the config in which an action is held until the next frame.

        Raises:
            InputError: it would be held for too long, or for a time that does not divide a second.
        """
        held = config.action_repeat * frame_stride
        if held > ACTION_REPEAT_LIMIT:
            raise InputError(
                f"frame_stride is {frame_stride} and action_repeat {config.action_repeat}: an "
                f"action of layout 'open-h' would be held for {held} control steps; allowed: at "
                f"most {ACTION_REPEAT_LIMIT}. Give a smaller frame_stride, or use "
                "surgicai-vision's own layout."
            )
        schema.check_spacing(frame_stride, config.action_repeat)
        return dataclasses.replace(config, action_repeat=held)


def instruction(task: str, phase: int) -> str:
    """Return the instruction in words for a task and the subtask's index in it (-1 for none)."""
    return task_text(names.SUBTASKS[phase] if phase >= 0 else task)
