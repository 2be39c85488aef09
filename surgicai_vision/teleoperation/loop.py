"""Driving: the loop that joins a session, a device, a screen and the clock."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.scene.rendering import FrameRenderer
from surgicai_vision.teleoperation.inputs import Device
from surgicai_vision.teleoperation.pacer import Pacer
from surgicai_vision.teleoperation.session import Session, Status

Images = Mapping[str, NDArray[Any]]
"""View → (size, size, 3) uint8."""


class Screen(Protocol):
    """Where the person sees."""

    def wants(self) -> bool:
        """Say whether a new image would be seen."""

    def show(self, images: Images, status: Status) -> None:
        """Show what the views see now; the images are the screen's to keep."""


class Views:
    """Draws the views of an env, in this thread.

    Args:
        env: the env.
        cameras: its views, in the order they are shown.
        size: side of an image [pixel].
    """

    def __init__(self, env: Any, cameras: tuple[str, ...], size: int):
        self._env, self._cameras, self._size = env, cameras, size
        self._renderer, self._draws = FrameRenderer(env.model, size, size), env.simulation.draws

    def look(self) -> Images:
        """Return what every view sees now."""
        if self._env.simulation.draws is not self._draws:  # the needle may have another shape now
            self.close()
            self._renderer, self._draws = (
                FrameRenderer(self._env.model, self._size, self._size),
                self._env.simulation.draws,
            )
        return {
            camera: self._renderer.render(self._env.data, camera, names.RGB)
            for camera in self._cameras
        }

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def drive(
    session: Session,
    device: Device,
    screen: Screen,
    views: Views,
    pacer: Pacer,
    heard: Callable[[Status], None] = lambda status: None,
) -> None:
    """Run the session until it stops.

    Args:
        session: what to run.
        device: where inputs come from.
        screen: where images go.
        views: what draws them.
        pacer: keeps the time.
        heard: called with the status after every tick that changed its message.
    """
    message, moment, images = "", None, views.look()
    while not session.over:
        session.tick(device.poll())
        status = session.status()
        if status.message != message:
            message = status.message
            heard(status)
        if screen.wants() and pacer.may_draw():
            now = (status.kept, status.discarded, status.skipped, status.steps)
            if now != moment:  # else nothing has moved since the last image
                moment, images = now, views.look()
            screen.show(images, status)
        pacer.wait()
    screen.show(images, session.status())
