"""Cameras: their poses, and the matrices that project a point of the world to a pixel.

Pixels and camera frames follow OpenCV: x right, y down, z forward; the centre of the first pixel is
(0, 0), so the principal point of a W × H image is ((W - 1) / 2, (H - 1) / 2). A world point p is
projected to the pixel `K (R p + t)`, divided by its third component, with `K = intrinsics(…)` and
`[R t] = inverse(extrinsics(…))`.

Sources: "front" is the left endoscope of SurgicAI's scene, moved as described at `ENDOSCOPE`;
"front_right" is the right one, and "back" the camera opposite them. "endo_left" and "endo_right"
are the eyes of a da Vinci Xi's endoscope in the same place, with its baseline, field of view and
sensor. SurgicAI's cameras are kept alongside them, because the comparison with its paper needs
their names, toe-in and 4 : 3 image. The surgical robotics challenge also puts a camera on each
insertion link; there it looks along the shaft and sees little else, so ours stand off the shaft and
aim at the jaws.

A crop ("front_psm2" and the like, `scene.crops`) is not a camera of the scene but a window of the
image that its camera takes at a higher resolution. It has that camera's pose, and that camera's K
with the principal point shifted by the window's corner.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.cameras import CAMERAS
from surgicai_vision.core.errors import InputError, UnknownName, check_name, shown
from surgicai_vision.core.names import ARMS, PSM1, PSM2
from surgicai_vision.scene.kinematics import INSTRUMENTS
from surgicai_vision.scene.rotations import matrix_to_quaternion

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


class Camera(Protocol):
    """What a camera's name stands for in a scene: a camera or a crop."""

    def add_to(self, spec: mujoco.MjSpec, name: str, instrument: str) -> None:
        """Add it to a scene with both arms, whose PSMs carry `instrument`."""


class Window(NamedTuple):
    """Where a crop lies in its camera's whole image [pixel]; its size is that of the drawn image.

    Attributes:
        left: column of the whole image in which the crop begins.
        top: row of the whole image in which it begins.
        height: of the whole image.
        width: of the whole image.
    """

    left: int
    top: int
    height: int
    width: int


PARALLEL = 1e-6
"""Sine of the angle below which two vectors count as parallel."""


def _check_vector(name: str, values: object) -> None:
    """Refuse anything but a vector of three finite numbers."""
    try:
        vector = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{name} is {shown(values)}; give three finite numbers.")


@dataclass(frozen=True)
class CameraPose:
    """A camera in the frame of the body that carries it.

    Attributes:
        position: the optical centre [m].
        direction: viewing direction; need not be a unit vector.
        up: any vector that points to the upper half of the image, not along `direction`.
        fovy: vertical field of view [rad], between 0 and π.
        body: name of the body that carries it; the world by default.

    Raises:
        InputError: a value that no camera can have.
    """

    position: Vector
    direction: Vector
    up: Vector
    fovy: float
    body: str = "world"

    def __post_init__(self) -> None:
        for name in ("position", "direction", "up"):
            _check_vector(name, getattr(self, name))
        fovy: object = self.fovy
        if not isinstance(fovy, int | float | np.floating) or not 0.0 < fovy < math.pi:
            raise InputError(
                f"fovy is {shown(fovy)}; give the vertical field of view in radians, between 0 "
                "and pi (math.radians(45) for 45 degrees)."
            )
        across = np.linalg.norm(np.cross(self.direction, self.up))
        if not across > PARALLEL * np.linalg.norm(self.direction) * np.linalg.norm(self.up):
            raise InputError(
                f"direction is {self.direction} and up is {self.up}; neither may be zero, and up "
                "must not lie along direction."
            )

    def add_to(self, spec: mujoco.MjSpec, name: str, instrument: str) -> None:
        """Add the camera to its body; its pose does not depend on `instrument`."""
        carrier = spec.body(self.body)
        if carrier is None:
            raise UnknownName("body", self.body, [item.name for item in spec.bodies])
        rotation = look_at(self.direction, self.up) * [1.0, -1.0, -1.0]  # MuJoCo's z is backwards
        carrier.add_camera(
            name=name,
            pos=list(self.position),
            quat=matrix_to_quaternion(rotation).tolist(),
            fovy=math.degrees(self.fovy),
        )


@dataclass(frozen=True)
class WristCamera:
    """The camera on an arm's insertion link.

    Attributes:
        arm: one of `names.ARMS`.
    """

    arm: str

    def add_to(self, spec: mujoco.MjSpec, name: str, instrument: str) -> None:
        """Add the camera where it sees the jaws of `instrument`."""
        wrist_camera(self.arm, instrument).add_to(spec, name, instrument)


@dataclass(frozen=True)
class Crop:
    """A window of a camera's image around the place where an arm reports its jaws.

    The place is computed from the arm's reported joints and the camera's nominal calibration
    (`envs.calibration`), never taken from the scene.

    Attributes:
        camera: name of the camera whose image is cropped.
        arm: one of `names.ARMS`.
        distance: from the camera, along its axis, at which `span` holds [m].
        span: height of what the crop shows there [m].
        aspect: width of the whole image over its height, by default that of 640 × 480 (SurgicAI).

    Raises:
        InputError: no such arm, or a number that is not finite and above 0.
    """

    camera: str
    arm: str
    distance: float
    span: float
    aspect: float = 4.0 / 3.0

    def __post_init__(self) -> None:
        check_name("arm of a crop", self.arm, ARMS)
        for attribute in ("distance", "span", "aspect"):
            value: object = getattr(self, attribute)
            if not isinstance(value, int | float | np.floating) or not 0.0 < value < math.inf:
                raise InputError(
                    f"{attribute} of the crop of {self.camera} is {shown(value)}; it must be a "
                    "finite number above 0."
                )

    def add_to(self, spec: mujoco.MjSpec, name: str, instrument: str) -> None:
        """Add nothing: the camera whose image is cropped is already in the scene."""


def look_at(direction: Vector, up: Vector) -> Array:
    """Return the rotation (3, 3) of an OpenCV camera frame that looks along `direction`.

    `up` points upwards in its image.
    """
    forward: Array = np.array(direction, dtype=np.float64)
    forward /= np.linalg.norm(forward)
    right: Array = np.asarray(np.cross(forward, np.array(up, dtype=np.float64)), dtype=np.float64)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


ENDOSCOPE = (-0.008, 0.100, 0.160)
ENDOSCOPE_DIRECTION = (0.040, -0.451, -0.892)
ENDOSCOPE_FOVY = 0.9
"""The endoscope's midpoint [m], its direction, and the vertical field of view [rad] of both its
cameras.

SurgicAI's endoscope is at (0, 114.2, 148.8) mm, looks along (0, -0.642, -0.765) and sees 1.2 rad at
640 × 480. From there, at 224 × 224, the needle covers 31 pixels at the end of a handoff even
without the arms. PSM2 holds it along the wound, which is also the line of sight, so place ends with
5 to 15 pixels in view. Moved 8 mm to PSM2's side, 14 mm forwards and 11 mm up, with 0.9 rad, the
endoscope sees more than 25 pixels of it at the end of grasp, place, insert and handoff, and both
arms at the start (`tests/scene/test_visibility.py`).
"""
BASELINE = 0.004
"""Distance between the endoscope's two cameras [m] (SurgicAI)."""
TOE_IN = 0.040
"""x component of the direction of each of them, 2.3° (SurgicAI)."""


def _endoscope(side: float) -> CameraPose:
    """Return the left (side = 1) or the right (-1) camera.

    Left is +x, because the endoscope looks along -y.
    """
    x, y, z = ENDOSCOPE
    across, forward, down = ENDOSCOPE_DIRECTION
    return CameraPose(
        position=(x + side * BASELINE / 2, y, z),
        direction=(across - side * TOE_IN, forward, down),
        up=(0.0, down, -forward),
        fovy=ENDOSCOPE_FOVY,
    )


DA_VINCI_SIZE = (1024, 1280)
"""Height and width of a da Vinci Xi's images [pixel] (EndoVis 2017)."""
DA_VINCI_FOCAL = 1084.0
"""Focal length of both its eyes [pixel]; they see 50.6° in height and 61.1° in width.

Source: a calibration of the da Vinci Xi of the EndoVis 2017 challenges (kidney boundary detection,
data set 18, quoted in the README of ghattab/kidney-edge-detection): 1084.21, 1084.05 pixels left,
1083.43, 1083.22 right. Both principal points lie 50 pixels inwards there. This shifts the images
but changes no ray, so it is left out, as is the lens distortion (k1 below .001).
"""
DA_VINCI_FOVY = 2.0 * math.atan(DA_VINCI_SIZE[0] / 2.0 / DA_VINCI_FOCAL)
"""Vertical field of view of its eyes [rad]."""
DA_VINCI_BASELINE = 0.00435
"""Distance between its eyes [m], whose axes are parallel to 0.07° (the same calibration)."""
DA_VINCI_SHAFT = 0.0044
"""Radius of its shaft [m]: an "8 mm endoscope" through an 8.8 mm cannula."""
DA_VINCI_TILT = math.radians(30.0)
"""Angle between its shaft and its optical axis [rad]: the 30° endoscope, looking down; there is one
of 0° too. The shaft is not drawn: it comes from between the arms' ports and passes over both
(`tests/scene/test_endoscope.py`)."""


def _da_vinci(side: float) -> CameraPose:
    """Return the left (side = 1) or the right (-1) eye, about `ENDOSCOPE`, axes parallel."""
    rotation = look_at(ENDOSCOPE_DIRECTION, (0.0, 0.0, 1.0))
    x, y, z = np.array(ENDOSCOPE) - rotation[:, 0] * side * DA_VINCI_BASELINE / 2.0
    return CameraPose(
        position=(float(x), float(y), float(z)),
        direction=ENDOSCOPE_DIRECTION,
        up=(0.0, 0.0, 1.0),
        fovy=DA_VINCI_FOVY,
    )


FRONT = _endoscope(1.0)
FRONT_RIGHT = _endoscope(-1.0)
BACK = CameraPose((0.0, -0.0359, 0.1659), (0.0, 0.707, -0.707), (0.0, 0.707, 0.707), 0.8)
"""Poses in world; "back" is where SurgicAI's is."""
ENDO_LEFT = _da_vinci(1.0)
ENDO_RIGHT = _da_vinci(-1.0)
WRIST_PSM1 = WristCamera(PSM1)
WRIST_PSM2 = WristCamera(PSM2)

WRIST_ASIDE = 0.030
"""Distance of the wrist camera from the shaft [m]."""
WRIST_BACK = 0.030
"""Distance from the wrist's pitch axis to the wrist camera, up along the shaft [m].

With these two distances the line of sight meets the shaft at 33°: enough to look past it at the
jaws, with the camera clear of the tissue in every grasp of the five subtasks.
"""
WRIST_SIDE = MappingProxyType(
    {PSM1: (-math.sqrt(0.5), -math.sqrt(0.5)), PSM2: (-math.sqrt(0.5), math.sqrt(0.5))}
)
"""Arm → side of the shaft on which its camera is, in x and y of the insertion link: above and
outside. Of the eight sides tried, this one showed the jaws, the needle and the holes best at the
ends of all subtasks."""
WRIST_TARGET = 0.017
"""Point beyond the wrist's pitch axis at which the wrist camera aims [m]: 2 mm before the grasp."""
WRIST_FOVY = 0.8
"""Vertical field of view of the wrist cameras [rad]: about 47 mm at the jaws, over two needles."""


def wrist_camera(arm: str, instrument: str) -> CameraPose:
    """Return the wrist camera's pose on the arm's insertion link, whose z axis is the shaft."""
    x, y = (WRIST_ASIDE * side for side in WRIST_SIDE[arm])
    return CameraPose(
        position=(x, y, INSTRUMENTS[instrument].tool - WRIST_BACK),
        direction=(-x, -y, WRIST_TARGET + WRIST_BACK),
        up=(-x, -y, 0.0),
        fovy=WRIST_FOVY,
        body=f"{arm}_outer_insertion_link",
    )


def add_cameras(spec: mujoco.MjSpec, names: Iterable[str], instrument: str) -> None:
    """Add the cameras called `names` to a scene with both arms.

    Raises:
        InputError: a camera of another distribution is not a camera, or cannot be added.
    """
    for name in names:
        camera = CAMERAS.load(name)
        with CAMERAS.calling(name):
            camera.add_to(spec, name, instrument)


def intrinsics(
    model: mujoco.MjModel, camera: str, height: int, width: int, window: Window | None = None
) -> Array:
    """Return the camera matrix K (3, 3) [pixel] of an image of `height` × `width`.

    Args:
        model: the scene's model, or an env's own, whose cameras may have been moved.
        camera: name of a camera, or of a crop.
        height: of the image [pixel].
        width: of the image [pixel].
        window: where the image lies in the camera's whole image; required for a crop.

    Raises:
        UnknownName: no such camera in the model.
        InputError: a crop without its window.
    """
    index = camera_id(model, camera)
    if window is None and stand(camera) != camera:
        raise InputError(
            f"The position of the crop '{camera}' differs from frame to frame; give its window, "
            "or ask the env: env.calibration.intrinsics(view)."
        )
    left, top, height, width = window or Window(0, 0, height, width)
    focal = height / 2 / math.tan(math.radians(float(model.cam_fovy[index])) / 2)
    return np.array(
        [
            [focal, 0.0, (width - 1) / 2 - left],
            [0.0, focal, (height - 1) / 2 - top],
            [0.0, 0.0, 1.0],
        ]
    )


def extrinsics(model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> Array:
    """Return T_world_camera (4, 4) in the state `data`, after `mj_forward`.

    A crop has the pose of its camera.

    Raises:
        UnknownName: no such camera in the model.
    """
    index = camera_id(model, camera)
    pose = np.eye(4)
    pose[:3, :3] = data.cam_xmat[index].reshape(3, 3) * [1.0, -1.0, -1.0]
    pose[:3, 3] = data.cam_xpos[index]
    return pose


def crop_of(view: str) -> Crop | None:
    """Return the crop called `view`, or None for a camera of the scene or an unknown name."""
    part = CAMERAS.load(view) if view in CAMERAS.names() else None
    return part if isinstance(part, Crop) else None


def stand(view: str) -> str:
    """Return the name of the camera that takes a view: a crop's camera, or `view` itself."""
    crop = crop_of(view)
    return view if crop is None else crop.camera


def camera_id(model: mujoco.MjModel, camera: str) -> int:
    """Return the index of a camera by its name; for a crop, that of its camera.

    Raises:
        UnknownName: listing the model's cameras.
    """
    name = stand(camera)
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if index < 0:
        raise UnknownName("camera", name, [model.camera(i).name for i in range(model.ncam)])
    return int(index)
