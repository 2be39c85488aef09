"""Cameras: where they stand, and the matrices that take a point of the world into a pixel.

Pixels and camera frames follow OpenCV: x right, y down, z forward; the centre of the first pixel is
(0, 0), so the principal point of a W × H image is ((W - 1) / 2, (H - 1) / 2). A point p of the
world has the pixel `K (R p + t)` divided by its third component, with `K = intrinsics(…)` and `[R
t] = inverse(extrinsics(…))`.

Sources: "front" is the left endoscope of SurgicAI's scene, moved as `ENDOSCOPE` says; "front_right"
the right one; "back" the camera opposite to them. The surgical robotics challenge also puts a
camera on each insertion link; there it looks along the shaft and sees little else, so ours stand
off it and aim at the jaws.

"front_psm2" and its like follow an arm's jaws from where "front" or "back" stands: what one cuts
out of an image of higher resolution about the jaws, whose place the arm's joints tell, and scales
to the size of the others.
"""

import math
from dataclasses import dataclass
from types import MappingProxyType

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import UnknownName
from surgicai_vision.core.names import ARMS, FOLLOWING_CAMERAS, PSM1, PSM2
from surgicai_vision.scene.kinematics import INSTRUMENTS
from surgicai_vision.scene.rotations import matrix_to_quaternion

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class CameraPose:
    """A camera in the frame of the body that carries it.

    Attributes:
        position: the optical centre [m].
        direction: of view; need not be a unit vector.
        up: any vector in the upper half of the image.
        fovy: vertical field of view [rad].
    """

    position: Vector
    direction: Vector
    up: Vector
    fovy: float


ENDOSCOPE = (-0.008, 0.100, 0.160)
ENDOSCOPE_DIRECTION = (0.040, -0.451, -0.892)
ENDOSCOPE_FOVY = 0.9
"""The endoscope's middle [m], its direction, and the vertical field of view [rad] of both its
cameras.

SurgicAI's stands at (0, 114.2, 148.8) mm, looks along (0, -0.642, -0.765) and sees 1.2 rad at 640 ×
480. There, at 224 × 224, the needle covers 31 pixels at the end of a handoff even with both arms
     taken away; and PSM2 holds it along
the wound, which is the line of sight, so that placing ends with 5 to 15 pixels in view. 8 mm to
PSM2's side, 14 mm forwards, 11 mm up and 0.9 rad bring it above 25 at the end of grasp, place,
insert and handoff, with both arms still in view at the start (`tests/test_visibility.py`).
"""
BASELINE, TOE_IN = 0.004, 0.040
"""Between the endoscope's two cameras [m]; x of each one's direction, 2.3° (SurgicAI)."""


def _endoscope(side: float) -> CameraPose:
    """Return the left (side = 1) or the right (-1) camera: left is +x, for the endoscope looks
    along -y.
    """
    x, y, z = ENDOSCOPE
    across, forward, down = ENDOSCOPE_DIRECTION
    return CameraPose(
        position=(x + side * BASELINE / 2, y, z),
        direction=(across - side * TOE_IN, forward, down),
        up=(0.0, down, -forward),
        fovy=ENDOSCOPE_FOVY,
    )


WORLD_CAMERAS = MappingProxyType(
    {
        "front": _endoscope(1.0),
        "front_right": _endoscope(-1.0),
        "back": CameraPose((0.0, -0.0359, 0.1659), (0.0, 0.707, -0.707), (0.0, 0.707, 0.707), 0.8),
    }
)
"""Camera → pose in world; "back" stands where SurgicAI's does."""

WRIST_ASIDE, WRIST_BACK = 0.030, 0.030
"""From the wrist's pitch axis to the wrist camera: beside the shaft and up along it [m]. So the
view meets the shaft at 33°: far enough to look past it at the jaws, and clear of the tissue in
every grasp of the five subtasks."""
WRIST_SIDE = MappingProxyType(
    {PSM1: (-math.sqrt(0.5), -math.sqrt(0.5)), PSM2: (-math.sqrt(0.5), math.sqrt(0.5))}
)
"""Arm → side of the shaft on which its camera stands, in x and y of the insertion link: above and
outside, where of eight sides tried the jaws, the needle and the holes were seen best at the ends of
all subtasks."""
WRIST_TARGET = 0.017
"""Point beyond the wrist's pitch axis at which the wrist camera aims [m]: 2 mm short of the jaws'
grasp point.
"""
WRIST_FOVY = 0.8
"""Vertical field of view of the wrist cameras [rad]: about 47 mm of the scene at the jaws, more
than two needles.
"""


def wrist_camera(arm: str, instrument: str) -> CameraPose:
    """Return the wrist camera's pose on the arm's insertion link, whose z axis is the shaft."""
    x, y = (WRIST_ASIDE * side for side in WRIST_SIDE[arm])
    return CameraPose(
        position=(x, y, INSTRUMENTS[instrument].tool - WRIST_BACK),
        direction=(-x, -y, WRIST_TARGET + WRIST_BACK),
        up=(-x, -y, 0.0),
        fovy=WRIST_FOVY,
    )


FOLLOWING_SPAN = 0.050
"""Height of what a following camera sees at the holes [m]: at 224 × 224 pixels 0.22 mm a pixel,
where "front" and "back" have 0.43 and 0.47; two and a half needles, and the jaws at their
middle."""
FOLLOWED = (0.0, 0.050, 0.075)
"""Point in world [m] at whose distance that holds: between the holes and the needle's home."""


def following_fovy(camera: str) -> float:
    """Return the vertical field of view [rad] of the cameras that stand where `camera` stands and
    follow the jaws.
    """
    return 2.0 * math.atan(
        FOLLOWING_SPAN / 2.0 / math.dist(WORLD_CAMERAS[camera].position, FOLLOWED)
    )


def add_following_cameras(spec: mujoco.MjSpec) -> None:
    """Add "front_psm1" … "back_psm2"; the arms, with their bodies `{arm}_grasp`, must be there."""
    for name in FOLLOWING_CAMERAS:
        camera, arm = name.split("_")
        spec.worldbody.add_camera(
            name=name,
            pos=list(WORLD_CAMERAS[camera].position),
            mode=mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY,
            targetbody=f"{arm}_grasp",
            fovy=math.degrees(following_fovy(camera)),
        )


def add_world_cameras(spec: mujoco.MjSpec) -> None:
    """Add "front", "front_right" and "back" to the world."""
    for name, pose in WORLD_CAMERAS.items():
        _add(spec.worldbody, name, pose)


def add_wrist_camera(
    spec: mujoco.MjSpec, arm: str, instrument: str = "400006", body: str | None = None
) -> None:
    """Add `wrist_{arm}` to the arm's insertion link, or to the named body with that link's axes."""
    carrier = body or f"{arm}_outer_insertion_link"
    found = spec.body(carrier)
    if found is None:
        raise UnknownName("body", carrier, [item.name for item in spec.bodies])
    _add(found, f"wrist_{arm}", wrist_camera(arm, instrument))


def add_cameras(spec: mujoco.MjSpec, instrument: str = "400006") -> None:
    """Add all cameras to a finished scene with both arms."""
    add_world_cameras(spec)
    for arm in ARMS:
        add_wrist_camera(spec, arm, instrument)
    add_following_cameras(spec)


def look_at(direction: Vector, up: Vector) -> Array:
    """Return the rotation (3, 3) of an OpenCV camera frame that looks along `direction` with `up`
    upwards.
    """
    forward: Array = np.array(direction, dtype=np.float64)
    forward /= np.linalg.norm(forward)
    right: Array = np.asarray(np.cross(forward, np.array(up, dtype=np.float64)), dtype=np.float64)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def intrinsics(model: mujoco.MjModel, camera: str, height: int, width: int) -> Array:
    """Return the camera matrix K (3, 3) [pixel] of an image of `height` × `width`.

    Raises:
        UnknownName: no such camera in the model.
    """
    focal = height / 2 / math.tan(math.radians(float(model.cam_fovy[camera_id(model, camera)])) / 2)
    return np.array(
        [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
    )


def extrinsics(model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> Array:
    """Return T_world_camera (4, 4) at the state of `data`, which must have been through
    `mj_forward`.

    Raises:
        UnknownName: no such camera in the model.
    """
    index = camera_id(model, camera)
    pose = np.eye(4)
    pose[:3, :3] = data.cam_xmat[index].reshape(3, 3) * [1.0, -1.0, -1.0]
    pose[:3, 3] = data.cam_xpos[index]
    return pose


def camera_id(model: mujoco.MjModel, camera: str) -> int:
    """Return the index of a camera by its name.

    Raises:
        UnknownName: listing the model's cameras.
    """
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    if index < 0:
        raise UnknownName("camera", camera, [model.camera(i).name for i in range(model.ncam)])
    return int(index)


def _add(body: mujoco.MjsBody, name: str, pose: CameraPose) -> None:
    """Add one camera; MuJoCo's camera frame is OpenCV's turned half about x."""
    rotation = look_at(pose.direction, pose.up) * [1.0, -1.0, -1.0]
    quaternion = matrix_to_quaternion(rotation).tolist()
    body.add_camera(
        name=name, pos=list(pose.position), quat=quaternion, fovy=math.degrees(pose.fovy)
    )
