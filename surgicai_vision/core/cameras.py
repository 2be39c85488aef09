"""Cameras and views by name: ours, registered ones and those of other distributions.

A view is what a policy may see of a camera: its colours, under the camera's name, or its depth. A
crop of a camera's image is registered, named and requested like a camera.
"""

import zlib
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name, shown
from surgicai_vision.core.plugins import CAMERAS_GROUP, NameCollision, Registry

if TYPE_CHECKING:
    from surgicai_vision.scene.cameras import Camera


def _target(name: str) -> str:
    """Return where one of our cameras or crops is defined, "module:attribute"."""
    module = "crops" if name in names.CROPS else "cameras"
    return f"surgicai_vision.scene.{module}:{name.upper()}"


def _fault(part: object) -> str:
    """Return what is wrong with a part offered as a camera, "" if nothing."""
    if not isinstance(part, type) and callable(getattr(part, "add_to", None)):
        return ""
    return f"is {shown(part)}; it must be a scene.cameras.CameraPose or a scene.cameras.Crop"


CAMERAS: Final = Registry["Camera"](
    "camera",
    CAMERAS_GROUP,
    {name: _target(name) for name in names.CAMERAS},
    _fault,
)
"""Camera name → its `scene.cameras.Camera`; a crop is one as well (`scene.cameras.Crop`)."""


def register_camera(name: str, camera: "Camera", distribution: str = "") -> None:
    """Offer a camera under a new name in this process; envs made from now on have it.

    Raises:
        NameCollision: the name is taken.
        InputError: no camera can have this name, or this is not a camera.
    """
    _check_form(name)
    CAMERAS.register(name, camera, distribution)


def camera_names() -> tuple[str, ...]:
    """Return the name of every camera, ours first."""
    return CAMERAS.names()


def view_names() -> tuple[str, ...]:
    """Return the name of every view: all cameras, then the depth of each."""
    cameras = camera_names()
    return (*cameras, *(f"{camera}_depth" for camera in cameras))


def check_camera(name: str) -> str:
    """Return `name` if a camera has it, else raise `UnknownName`."""
    return CAMERAS.check(name)


def check_view(name: str) -> str:
    """Return `name` if a view has it, else raise `UnknownName`."""
    check_name("view", name, view_names())
    CAMERAS.check(names.camera_of(name))
    return name


def camera_number(name: str) -> int:
    """Return the camera's number, the same in every process, for seeding random numbers."""
    known = name in names.CAMERAS
    return names.CAMERAS.index(name) if known else zlib.crc32(name.encode())


def other_cameras() -> tuple[str, ...]:
    """Return the names of the cameras that are not ours and that one distribution alone offers.

    Raises:
        InputError: a name that no camera can have.
    """
    others: list[str] = []
    for name in camera_names()[len(names.CAMERAS) :]:
        with CAMERAS.calling(name):
            _check_form(name)
        with suppress(NameCollision):  # refused where it is used (`check_camera`)
            others.append(CAMERAS.check(name))
    return tuple(others)


def _check_form(name: str) -> None:
    """Refuse names that would be misread in a LeRobot key or in one of our files."""
    if not name.isidentifier() or name.endswith(("_depth", "_segmentation")):
        raise InputError(
            f"A camera cannot be called '{name}'; choose a name of letters, digits and _ that does "
            "not end in _depth or _segmentation."
        )
