"""Calibration: what an env's robot knows about its cameras, and where its crops lie.

* `intrinsics(view, size)`: K (3, 3) [pixel] of a view's image;
* `extrinsics(view)`: T_world_camera (4, 4) [m];
* `window(view, size)`: where a crop lies in its camera's whole image, None for a camera.

All of it is nominal: camera poses and fields of view are those of the scene without randomisation,
and an arm is where its joints report it to be, kinematic error included. A randomised camera is not
followed: it takes the image, but the window stays where the nominal calibration puts it.
"""

import functools
import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.envs import poses
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.scene import cameras
from surgicai_vision.scene.arm import GRASP_DEPTH
from surgicai_vision.scene.cameras import Crop, Window
from surgicai_vision.scene.crops import window_about
from surgicai_vision.scene.kinematics import Pose

Array = NDArray[np.float64]


class Calibration:
    """The nominal calibration of one env's views; see the module's docstring."""

    def __init__(self, simulation: Simulation):
        self._simulation = simulation
        self._model = simulation.scene.model
        self._standing: dict[str, Pose] = {}

    def intrinsics(self, view: str, size: tuple[int, int]) -> Array:
        """Return K (3, 3) [pixel] of a view's image of `size`, its height and width."""
        return cameras.intrinsics(self._model, view, *size, self.window(view, size))

    def extrinsics(self, view: str) -> Array:
        """Return T_world_camera (4, 4) of a view, OpenCV's axes [m]."""
        return poses.square(self._pose(cameras.stand(view)))

    def window(self, view: str, size: tuple[int, int]) -> Window | None:
        """Return where a crop of `size` lies in its camera's image; None for a camera.

        Raises:
            InputError: a crop that is larger than the image it is cut from.
        """
        crop = cameras.crop_of(view)
        return None if crop is None else self._window_of(crop, view, size)

    def _window_of(self, crop: Crop, view: str, size: tuple[int, int]) -> Window:
        """Return where a view that is a crop lies: about the jaws as its arm reports them."""
        grasp = poses.position(self.reported_grasp(crop.arm))
        in_camera = poses.transform(poses.invert(self._pose(crop.camera)), grasp)
        return window_about(crop, in_camera, self._fovy(crop.camera), *size)

    def reported_grasp(self, arm: str) -> Pose:
        """Return T_world_grasp of an arm from its reported joints and its nominal base."""
        simulation = self._simulation
        tip = poses.compose(simulation.bases[arm], simulation.tip_in_base(arm))
        return poses.shifted_along_z(tip, GRASP_DEPTH)

    def _fovy(self, camera: str) -> float:
        """Return a camera's vertical field of view [rad]."""
        return math.radians(float(self._model.cam_fovy[cameras.camera_id(self._model, camera)]))

    def _pose(self, camera: str) -> Pose:
        """Return a camera's pose in world; that of a stationary camera is computed only once."""
        if camera in self._standing:
            return self._standing[camera]
        pose = poses.flat(cameras.extrinsics(self._model, self._put_nominal(), camera))
        if self._model.cam_bodyid[cameras.camera_id(self._model, camera)] == 0:
            self._standing[camera] = pose
        return pose

    @functools.cached_property
    def _nominal(self) -> mujoco.MjData:
        """Return a state of the scene without randomisation; most envs never need one."""
        return mujoco.MjData(self._model)

    def _put_nominal(self) -> mujoco.MjData:
        """Return the nominal scene with its bodies where the reported joints put them."""
        simulation = self._simulation
        nominal = self._nominal
        nominal.qpos[:] = simulation.data.qpos
        for arm in names.ARMS:
            nominal.qpos[simulation.scene.arms[arm].qpos] = simulation.reported_joints(arm)
        mujoco.mj_kinematics(self._model, nominal)
        mujoco.mj_comPos(self._model, nominal)
        mujoco.mj_camlight(self._model, nominal)
        return nominal
