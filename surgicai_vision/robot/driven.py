"""Driven robot: what an agent may ask of a dVRK, simulated or real, from its topics alone.

Poses are those of the tip in the arm's base, as in the envs. If a robot's own frames differ,
`BagFrames` gives them, as for `import-demos`: `psm1` and `psm2` are T_base_frame, the frame of the
arm's `local/*` poses in our base of that arm; `tip` is T_tip_robot, the robot's tip frame in ours.
"""

import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.imports.rosbag.config import Frames as BagFrames
from surgicai_vision.envs import observation, poses
from surgicai_vision.envs.absolute import T_WORLD_VIEW
from surgicai_vision.envs.simulation import RELEASE_STEPS
from surgicai_vision.envs.suture import PULLOUT_PHASE
from surgicai_vision.evaluation.agent import Observation
from surgicai_vision.robot.arm import FINGER_SHARE
from surgicai_vision.robot.client import Client
from surgicai_vision.robot.frames import VIEW, WORLD, read_pose
from surgicai_vision.robot.guards import BASE
from surgicai_vision.robot.messages import (
    CompressedImage,
    Image,
    JointState,
    OperatingState,
    PoseStamped,
)
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import quaternion_to_matrix_flat

RELEASED = names.PSM2.upper()
"""The arm that lets go when the other arm's pull-out begins."""


@dataclass(frozen=True)
class Command:
    """What is sent to an arm: T_base_tip and one finger's angle [rad]."""

    pose: Pose
    jaw: float


@final
class DrivenRobot:
    """What an agent may ask of a dVRK (`evaluation.agent.Robot`), from its topics.

    Args:
        client: receives and sends messages.
        views: views of the agent.
        task: the agent's task, which determines the active arm.
        size: height and width of the images that the agent sees [pixel].
        frames: the robot's own frames, if they differ from ours.
        jaw_scale: ratio of one finger's angle to the robot's jaw angle.
    """

    def __init__(
        self,
        client: Client,
        views: tuple[str, ...],
        task: str,
        size: int,
        frames: BagFrames | None = None,
        jaw_scale: float = FINGER_SHARE,
    ):
        if not 0.0 < jaw_scale <= 2.0:
            raise InputError(f"jaw_scale is {jaw_scale:g}; allowed: above 0 to 2.")
        given = frames or BagFrames()
        self._frames = {"PSM1": _pose_of(given.psm1), "PSM2": _pose_of(given.psm2)}
        self.tip = _pose_of(given.tip)
        self.jaw_scale = jaw_scale
        self.client = client
        self.views = views
        self._size = size
        is_whole = task == names.SUTURE
        self.phase = 0 if is_whole else names.SUBTASKS.index(task)
        self._first = self.phase
        self._entered: Callable[[str], object] | None = None
        self.release_steps = 0

    def on_enter(self, tell: Callable[[str], object]) -> None:
        """Set whom to tell which subtask is entered: the judge of a served simulation."""
        self._entered = tell

    def begin(self) -> None:
        """Go back to the first subtask: an episode begins."""
        self.phase = self._first
        self.release_steps = 0

    @property
    def subtask(self) -> str:
        """Return the present subtask's name."""
        return names.SUBTASKS[self.phase]

    @property
    def active(self) -> str:
        """Return the active arm's name on the topics."""
        return names.ACTIVE_ARM[self.subtask].upper()

    @property
    def arms(self) -> tuple[str, ...]:
        """Return the arms that may be moved now."""
        return (self.active, RELEASED) if self.release_steps else (self.active,)

    # -- evaluation.agent.Robot --------------------------------------------------------------------

    def agent_pos(self) -> NDArray[np.float32]:
        """Return the active arm's measured tip in its base, (7,), in m and rad."""
        return np.array(self._seven(self.active), np.float32)

    def both_arms(self) -> NDArray[np.float32]:
        """Return both arms' `agent_pos`, psm1 first, (14,)."""
        return np.array([self._seven(arm.upper()) for arm in names.ARMS], np.float32).ravel()

    def setpoint(self) -> NDArray[np.float32]:
        """Return how far the active arm's set point lies from its measured tip, (7,)."""
        told = self.told(self.active)
        jaw = self._angle(f"/{self.active}/jaw/measured_js")
        return observation.setpoint(self.measured(self.active), jaw, told.pose, told.jaw)

    def enter(self, phase: int) -> None:
        """Make a subtask the present one, and its arm the active one."""
        if not 0 <= phase < len(names.SUBTASKS):
            raise InputError(f"There is no subtask {phase}; allowed: 0 to 4.")
        if phase == self.phase:
            return
        self.phase = phase
        self.release_steps = RELEASE_STEPS if phase == PULLOUT_PHASE else 0
        if self._entered is not None:
            self._entered(self.subtask)

    # -- what the guards and the driver read -------------------------------------------------------

    def measured(self, arm: str) -> Pose:
        """Return the measured T_base_tip of an arm."""
        return self._ours(arm, read_pose(self._pose(f"/{arm}/local/measured_cp")))

    def finger(self, arm: str) -> float:
        """Return one finger's measured angle of an arm [rad]."""
        return self._angle(f"/{arm}/jaw/measured_js")

    def told(self, arm: str) -> Command:
        """Return an arm's set points as the robot publishes them."""
        pose = self._ours(arm, read_pose(self._pose(f"/{arm}/local/setpoint_cp")))
        return Command(pose, self._angle(f"/{arm}/jaw/setpoint_js"))

    def frame(self, arm: str) -> tuple[str, Pose]:
        """Return the frame of an arm's `setpoint_cp` and our base in it, T_frame_base.

        It is computed from the same set point in the base and in the frame.
        """
        outer = self._pose(f"/{arm}/setpoint_cp")
        inner = read_pose(self._pose(f"/{arm}/local/setpoint_cp"))
        own = poses.compose(read_pose(outer), poses.invert(inner))
        return outer.header.frame, poses.compose(own, poses.invert(self._frames[arm]))

    def base_in(self, arm: str, frame: str) -> Pose:
        """Return the base in a workspace's frame, T_frame_base.

        Raises:
            InputError: the robot's own frame is a different one.
        """
        if frame == BASE:
            return poses.IDENTITY
        own, base = self.frame(arm)
        if own == frame:
            return base
        if (own, frame) == (VIEW, WORLD):  # the simulation's world, where its endoscope is fixed
            return poses.compose(T_WORLD_VIEW, base)
        raise InputError(
            f"{arm} reports poses in frame '{own}'; the workspace's frame is '{frame}'."
        )

    def operating(self, arm: str) -> tuple[str, bool]:
        """Return an arm's operating state, "" before the first, and whether it is homed."""
        heard = self.client.newest(f"/{arm}/operating_state")
        if heard is None or not isinstance(heard.message, OperatingState):
            return "", False
        return heard.message.state, heard.message.is_homed

    def input_topics(self) -> tuple[list[str], list[str]]:
        """Return the topics of poses and jaws that are read, and those of images."""
        channels = (
            *("local/measured_cp", "local/setpoint_cp", "setpoint_cp"),
            *("jaw/measured_js", "jaw/setpoint_js"),
        )
        states = [f"/{arm.upper()}/{channel}" for arm in names.ARMS for channel in channels]
        return states, [self.client.image_topic(view) for view in self.views]

    def observation(self) -> Observation:
        """Return the images, view → (height, width, 3), and the active arm's pose."""
        if not self.views:
            return np.zeros(0, np.float32)
        return {**self.images(), "agent_pos": self.agent_pos()}

    def images(self) -> dict[str, NDArray[np.uint8]]:
        """Return view → (height, width, 3)."""
        return {view: self._image(view) for view in self.views}

    def _seven(self, arm: str) -> list[float]:
        return observation.seven(arm.lower(), self.measured(arm), self.finger(arm))

    def _pose(self, topic: str) -> PoseStamped:
        heard = self.client.newest(topic)
        assert heard is not None and isinstance(heard.message, PoseStamped), (
            "the guards require an input first"
        )
        return heard.message

    def _angle(self, topic: str) -> float:
        """Return one finger's angle [rad] from a jaw's joint state."""
        heard = self.client.newest(topic)
        assert heard is not None and isinstance(heard.message, JointState), (
            "the guards require an input first"
        )
        if len(heard.message.position) != 1 or not math.isfinite(heard.message.position[0]):
            raise InputError(
                f"{topic} reports {heard.message.position}; a jaw has one finite angle."
            )
        return float(heard.message.position[0]) * self.jaw_scale

    def _ours(self, arm: str, pose: Pose) -> Pose:
        """Return T_base_tip for a tip pose in the robot's own frames."""
        return poses.compose(self._frames[arm], poses.compose(pose, poses.invert(self.tip)))

    def _image(self, view: str) -> NDArray[np.uint8]:
        heard = self.client.newest(self.client.image_topic(view))
        assert heard is not None, "the guards require an input first"
        message = heard.message
        if isinstance(message, CompressedImage):
            self._check_size(view, *_size_of(message))
            return _decoded(message)
        assert isinstance(message, Image)
        self._check_size(view, message.height, message.width)
        return np.frombuffer(message.data, np.uint8).reshape(self._size, self._size, 3)

    def _check_size(self, view: str, height: int, width: int) -> None:
        if (height, width) != (self._size, self._size):
            raise InputError(
                f"the images of {view} are {height} × {width}; the policy sees "
                f"{self._size} × {self._size}."
            )


def _size_of(message: CompressedImage) -> tuple[int, int]:
    """Return height and width of a compressed image [px]; only its header is read."""
    try:
        with Pillow.open(io.BytesIO(message.data), formats=("JPEG", "PNG")) as image:
            return image.height, image.width
    except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError):
        raise InputError(_unreadable(message)) from None


def _decoded(message: CompressedImage) -> NDArray[np.uint8]:
    """Return a compressed image as (height, width, 3)."""
    import cv2

    found = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    if found is None:
        raise InputError(_unreadable(message))
    frame: NDArray[np.uint8] = np.ascontiguousarray(found[..., ::-1]).astype(np.uint8, copy=False)
    return frame


def _unreadable(message: CompressedImage) -> str:
    return f"an image of format {message.format[:20]} cannot be read."


def _pose_of(values: tuple[float, ...]) -> Pose:
    """Return the pose from x y z and a quaternion w x y z; the identity for ()."""
    if not values:
        return poses.IDENTITY
    x, y, z, qw, qx, qy, qz = values
    return (x, y, z, *quaternion_to_matrix_flat(qw, qx, qy, qz))
