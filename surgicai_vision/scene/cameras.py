"""Cameras: where they stand, and the matrices that take a point of the world into a pixel.

Pixels and camera frames follow OpenCV: x right, y down, z forward; the centre of the first pixel is (0, 0), so
the principal point of a W × H picture is ((W - 1) / 2, (H - 1) / 2). A point p of the world has the pixel
`K (R p + t)` divided by its third component, with `K = intrinsics(…)` and `[R t] = inverse(extrinsics(…))`.

Sources: "front" is the left endoscope of SurgicAI's scene, "front_right" the right one (4 mm beside it, toed in
by 2.3° each), "back" the camera opposite to them. The surgical robotics challenge also puts a camera on each
insertion link; there it looks along the shaft and sees little else, so ours stand off it and aim at the jaws.
"""

import math
from dataclasses import dataclass
from types import MappingProxyType

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.errors import UnknownName
from surgicai_vision.names import ARMS
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
        up: any vector in the upper half of the picture.
        fovy: vertical field of view [rad].
    """

    position: Vector
    direction: Vector
    up: Vector
    fovy: float


WORLD_CAMERAS = MappingProxyType(
    {
        "front": CameraPose((0.0020, 0.1142, 0.1488), (-0.040, -0.642, -0.765), (0.0, -0.766, 0.643), 1.2),
        "front_right": CameraPose((-0.0020, 0.1142, 0.1488), (0.040, -0.642, -0.765), (0.0, -0.766, 0.643), 1.2),
        "back": CameraPose((0.0, -0.0359, 0.1659), (0.0, 0.707, -0.707), (0.0, 0.707, 0.707), 0.8),
    }
)
"""Camera → pose in world (SurgicAI's scene)."""

WRIST_OFFSET = (-0.022, 0.0, -0.040)
"""From the wrist's pitch axis to the wrist camera, along the axes of the insertion link [m]: beside the shaft on the
side away from the arm's base, and 40 mm up it. Free of the tissue for every insertion, and not behind the shaft."""
WRIST_TARGET = 0.017
"""Point beyond the wrist's pitch axis at which the wrist camera aims [m]: 2 mm short of the jaws' grasp point."""
WRIST_FOVY = 0.9
"""Vertical field of view of the wrist cameras [rad]: about 56 mm of the scene at the jaws, more than a needle."""


def wrist_camera(instrument: str) -> CameraPose:
    """Return the wrist camera's pose on the insertion link, whose z axis is the shaft."""
    x, y, z = WRIST_OFFSET
    return CameraPose(
        position=(x, y, INSTRUMENTS[instrument].tool + z),
        direction=(-x, -y, WRIST_TARGET - z),
        up=(-x, -y, 0.0),
        fovy=WRIST_FOVY,
    )


def add_world_cameras(spec: mujoco.MjSpec) -> None:
    """Add "front", "front_right" and "back" to the world."""
    for name, pose in WORLD_CAMERAS.items():
        _add(spec.worldbody, name, pose)


def add_wrist_camera(spec: mujoco.MjSpec, arm: str, instrument: str = "400006", body: str | None = None) -> None:
    """Add `wrist_{arm}` to the arm's insertion link, or to the named body with that link's axes."""
    carrier = body or f"{arm}_outer_insertion_link"
    found = spec.body(carrier)
    if found is None:
        raise UnknownName("body", carrier, [item.name for item in spec.bodies])
    _add(found, f"wrist_{arm}", wrist_camera(instrument))


def add_cameras(spec: mujoco.MjSpec, instrument: str = "400006") -> None:
    """Add all cameras to a finished scene with both arms."""
    add_world_cameras(spec)
    for arm in ARMS:
        add_wrist_camera(spec, arm, instrument)


def look_at(direction: Vector, up: Vector) -> Array:
    """Return the rotation (3, 3) of an OpenCV camera frame that looks along `direction` with `up` upwards."""
    forward: Array = np.array(direction, dtype=np.float64)
    forward /= np.linalg.norm(forward)
    right: Array = np.asarray(np.cross(forward, np.array(up, dtype=np.float64)), dtype=np.float64)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def intrinsics(model: mujoco.MjModel, camera: str, height: int, width: int) -> Array:
    """Return the camera matrix K (3, 3) [pixel] of a picture of `height` × `width`.

    Raises:
        UnknownName: no such camera in the model.
    """
    focal = height / 2 / math.tan(math.radians(float(model.cam_fovy[camera_id(model, camera)])) / 2)
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


def extrinsics(model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> Array:
    """Return T_world_camera (4, 4) at the state of `data`, which must have been through `mj_forward`.

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
    body.add_camera(name=name, pos=list(pose.position), quat=quaternion, fovy=math.degrees(pose.fovy))
