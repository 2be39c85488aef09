"""BagConfig: how a bag is read.

It says where the poses are, in which frames and units, and how a recording becomes episodes. One of
two conventions sets what is not given. `dvrk` is the da Vinci Research Kit's CRTK interface: its
needle drivers' tip frame is on the wrist's yaw axis and oriented like ours (source:
`tooltip-offset` of its tool files 400006 and 420006), and its jaw is the angle between the fingers,
twice ours. `ambf` is the CRTK interface of the surgical robotics challenge: it has the same tip,
and its jaw is one finger's angle, of which only the command is published.
"""

import dataclasses
import difflib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from surgicai_vision.core import names
from surgicai_vision.core.config import STEPS
from surgicai_vision.core.errors import InputError, check_name

METADATA = "metadata.yaml"
ENDINGS = (".bag", ".db3", ".mcap")
"""What marks a folder as a bag of ROS 2, and a file as one of ROS 1 or 2."""

NOTHING = "none"
"""The label of samples that belong to no subtask."""
SEGMENTATIONS = ("auto", "labels", "events", NOTHING)
CLOCKS = ("auto", "stamp", "bag")
LABELS: Mapping[str, str] = MappingProxyType(
    {
        **{name: name for name in names.SUBTASKS},
        **{str(index): name for index, name in enumerate(names.SUBTASKS)},
        "approach": "grasp",
        "regrasp": "handoff",
        "": NOTHING,
        NOTHING: NOTHING,
        "idle": NOTHING,
        "-1": NOTHING,
    }
)
"""Label, in lower case → subtask: our names and indices, and SurgicAI's names."""


def printable(text: object, max_length: int = 80) -> str:
    """Return text from a bag as one printable line of limited length."""
    shown = "".join(char if char.isprintable() else "?" for char in str(text)[: max_length + 1])
    return shown if len(shown) <= max_length else f"{shown[: max_length - 1]}…"


def topic_list(topics: Collection[str], wanted: str, max_length: int = 450) -> str:
    """Return topics as one line of limited length, those most similar to the wanted one first."""
    shown: list[str] = []
    length = 0

    def difference(topic: str) -> tuple[float, str]:
        return -difflib.SequenceMatcher(None, wanted, topic.split(" ")[0]).ratio(), topic

    for topic in sorted(topics, key=difference):
        length += len(topic) + 2
        if length > max_length:
            return f"{', '.join(shown)} and {len(topics) - len(shown)} more"
        shown.append(topic)
    return ", ".join(shown) or "none at all"


def is_bag(path: Path) -> bool:
    """Return True for a path with a bag's ending, or a folder with a `metadata.yaml`."""
    return (path / METADATA).is_file() if path.is_dir() else path.suffix in ENDINGS


def bags_in(path: Path) -> list[Path]:
    """Return the bag at `path`, or the bags in the folder `path` sorted by name."""
    if is_bag(path) or not path.is_dir():
        return [path] if is_bag(path) else []
    return sorted(child for child in path.iterdir() if is_bag(child))


@dataclass(frozen=True)
class Topics:
    """Role → topic; None uses the convention's.

    Attributes:
        psm1_pose, psm2_pose: tip pose in the arm's base.
        psm1_joints, psm2_joints: the arm's six joints, used where there is no pose.
        psm1_jaw, psm2_jaw: jaw angle.
        needle: pose of the needle in world.
        label: which subtask is under way.
    """

    psm1_pose: str | None = None
    psm1_joints: str | None = None
    psm1_jaw: str | None = None
    psm2_pose: str | None = None
    psm2_joints: str | None = None
    psm2_jaw: str | None = None
    needle: str | None = None
    label: str | None = None

    def __post_init__(self) -> None:
        for role, topic in self.given().items():
            if not topic.startswith("/") or not topic.strip("/"):
                raise InputError(
                    f"topic of {role} is '{topic}'; "
                    "a topic begins with '/', like /PSM1/measured_cp."
                )

    def given(self) -> dict[str, str]:
        """Return the topics that are not None."""
        return {
            role: topic for role, topic in dataclasses.asdict(self).items() if topic is not None
        }


@dataclass(frozen=True)
class Convention:
    """What one kind of system publishes.

    Attributes:
        topics: role → topic.
        jaw_scale: one finger's angle divided by the recorded jaw angle.
    """

    topics: Mapping[str, str]
    jaw_scale: float


def _topics(arm: str, jaw: str, needle: str) -> Mapping[str, str]:
    """Return a convention's topics; `arm` is the arms' prefix without its digit."""
    kinds = {"pose": "measured_cp", "joints": "measured_js", "jaw": jaw}
    arms = {f"psm{n}_{role}": f"{arm}{n}/{name}" for n in (1, 2) for role, name in kinds.items()}
    return MappingProxyType({**arms, "needle": needle, "label": "/subtask"})


CONVENTIONS: Mapping[str, Convention] = MappingProxyType(
    {
        "dvrk": Convention(_topics("/PSM", "jaw/measured_js", "/needle/measured_cp"), 0.5),
        "ambf": Convention(_topics("/CRTK/psm", "jaw/servo_jp", "/CRTK/Needle/measured_cp"), 1.0),
    }
)


@dataclass(frozen=True)
class Frames:
    """Where the recording's frames are, each x y z [m] and a quaternion w x y z; () means ours.

    Attributes:
        psm1, psm2: T_base_frame, the frame of the arm's poses in the arm's base.
        tip: T_tip_recorded, the recorded tip frame in ours.
        needle: T_world_frame, the frame of the needle's poses in world.
        needle_offset: T_needle_recorded, the recorded needle frame in ours (origin at the arc's
            centre, base at -x, +z normal).
    """

    psm1: tuple[float, ...] = ()
    psm2: tuple[float, ...] = ()
    tip: tuple[float, ...] = ()
    needle: tuple[float, ...] = ()
    needle_offset: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name, pose in dataclasses.asdict(self).items():
            if not pose:
                continue
            if (
                len(pose) != 7
                or not all(map(math.isfinite, pose))
                or abs(math.hypot(*pose[3:]) - 1.0) > 1e-3
            ):
                raise InputError(
                    f"frames: {name} is {list(pose)}; "
                    "it must be seven numbers, x y z [m] and a unit quaternion w x y z."
                )


@dataclass(frozen=True)
class BagConfig:
    """How a bag is read.

    Attributes:
        convention: a key of `CONVENTIONS`.
        topics: topics that differ from the convention's.
        frames: frames that differ from ours.
        jaw_scale: one finger's angle divided by the recorded one; None uses the convention's.
        length_scale: metres per unit of length of the recording, for the arms' poses and joint
            insertions.
        needle_scale: the same for the needle's poses; None: 0.1 for AMBF's own states, whose scenes
            are ten times as large, otherwise 1.
        segmentation: "labels", "events" (contact and holes; needs the needle), "none" (the whole
            recording is one episode), or "auto": the first of these that the recording allows.
        labels: further labels → subtask, or "none".
        clock: "stamp" (headers), "bag" (time of reception), or "auto": stamps where there are any.
        max_gap: longest time between two messages that is bridged [s].
        speed: how much faster than recorded the motion becomes.
        drop_pauses: leave out samples in which the active arm rests (below 0.2 mm/s and 0.1 °/s).
        step: step preset; None uses the smallest that is fast enough.
    """

    convention: str = "dvrk"
    topics: Topics = field(default_factory=Topics)
    frames: Frames = field(default_factory=Frames)
    jaw_scale: float | None = None
    length_scale: float = 1.0
    needle_scale: float | None = None
    segmentation: str = "auto"
    labels: dict[str, str] = field(default_factory=dict)
    clock: str = "auto"
    max_gap: float = 0.2
    speed: float = 1.0
    drop_pauses: bool = True
    step: str | None = None

    def __post_init__(self) -> None:
        check_name("convention", self.convention, CONVENTIONS)
        check_name("segmentation", self.segmentation, SEGMENTATIONS)
        check_name("clock", self.clock, CLOCKS)
        if self.step is not None:
            check_name("step preset", self.step, STEPS)
        for label, subtask in self.labels.items():
            check_name(f"subtask of label '{label}'", subtask, (*names.SUBTASKS, NOTHING))
        for name, value in {
            "jaw_scale": self.jaw_scale,
            "length_scale": self.length_scale,
            "needle_scale": self.needle_scale,
            "max_gap": self.max_gap,
            "speed": self.speed,
        }.items():
            if value is not None and not (0.0 < value < 1e6):
                raise InputError(f"{name} is {value}; it must be above 0.")

    @property
    def all_topics(self) -> dict[str, str]:
        """Return role → topic, as given or else the convention's."""
        return {**CONVENTIONS[self.convention].topics, **self.topics.given()}

    @property
    def jaw(self) -> float:
        """Return one finger's angle divided by the recorded jaw angle."""
        return CONVENTIONS[self.convention].jaw_scale if self.jaw_scale is None else self.jaw_scale

    def subtask_of(self, label: str) -> str:
        """Return the subtask that a label means, or "none".

        Raises:
            InputError: an unknown label.
        """
        table = {**LABELS, **{str(key).lower(): value for key, value in self.labels.items()}}
        key = label.strip().lower()
        if key not in table:
            shown = printable(label)
            raise InputError(
                f"The recording has the label '{shown}'; known labels: "
                f"{', '.join(filter(None, table))}. Map it to a subtask in the --config file: "
                f"`bag: {{labels: {{'{shown}': grasp}}}}`, or to none."
            )
        return table[key]
