"""Loop: joins a session, an input device, a screen and the clock."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from surgicai_vision.core.pacer import Pacer
from surgicai_vision.core.web.screen import Images
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.teleoperation.inputs import Device
from surgicai_vision.teleoperation.session import Session, Status


class Screen(Protocol):
    """Shows images and the session's status to a person."""

    def wants_image(self) -> bool:
        """Return True if a new image would be seen."""

    def show(self, images: Images, status: Status) -> None:
        """Show new images and the status; the screen may keep the images."""


class Views(Protocol):
    """Renders what a session's views show."""

    def render(self) -> Images:
        """Return the current image of every view."""


class EnvViews:
    """Renders the views of an env, in this thread.

    Args:
        env: the env.
        cameras: its views, in the order they are shown.
        size: side of an image [pixel].
    """

    def __init__(self, env: SuturingEnv, cameras: tuple[str, ...], size: int):
        self._env = env
        self._cameras = cameras
        self._size = (size, size)

    def render(self) -> Images:
        """Return the current image of every view."""
        return {
            camera: self._env.image(camera, self._size).astype(np.uint8, copy=False)
            for camera in self._cameras
        }


def run_session(
    session: Session,
    device: Device,
    screen: Screen,
    views: Views,
    pacer: Pacer,
    on_message: Callable[[Status], None] = lambda status: None,
) -> None:
    """Run the session until it stops.

    Args:
        session: the session.
        device: the source of its inputs.
        screen: shows images and status.
        views: renders the images.
        pacer: keeps the time.
        on_message: called with the status after every tick that changed its message.
    """
    message = ""
    progress: tuple[int, ...] = ()
    images = views.render()
    while not session.over:
        session.tick(device.poll())
        status = session.status()
        if status.message != message:
            message = status.message
            on_message(status)
        if screen.wants_image() and pacer.can_draw():
            now = (status.kept, status.discarded, status.skipped, status.steps)
            if now != progress:  # else nothing has moved since the last image
                progress = now
                images = views.render()
            screen.show(images, status)
        pacer.wait()
    screen.show(images, session.status())
