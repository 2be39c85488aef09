"""Views: the images of an env being watched, from any cameras and one that a person moves."""

from typing import TYPE_CHECKING, final

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.web.screen import Images
from surgicai_vision.envs.camera_rig import Images as Rig
from surgicai_vision.envs.live.browser import FREE, VIEW_COMMANDS, Command
from surgicai_vision.scene.orbit import Orbit

if TYPE_CHECKING:
    from surgicai_vision.envs.base import SuturingEnv


@final
class LiveViews:
    """Draws the views that are shown, in the thread that steps the env.

    It has its own renderer, because the env's observations have another size.

    Args:
        env: the env.
        shown: views, the leading one first; `FREE` is the free camera.
        size: height and width of an image [px].
    """

    def __init__(self, env: "SuturingEnv", shown: tuple[str, ...], size: int):
        self.shown = shown
        self.orbit = Orbit()
        self._env = env
        self._size = (size, size)
        self._rig = Rig(env.simulation, env.calibration)

    def handle(self, command: Command) -> bool:
        """Follow a command; return False if it is not one of `VIEW_COMMANDS`."""
        if command.name not in VIEW_COMMANDS:
            return False
        if command.name == "views":
            self.shown = command.views
        elif command.name == "turn":
            self.orbit = self.orbit.turned(*command.numbers)
        elif command.name == "shift":
            self.orbit = self.orbit.shifted(*command.numbers)
        elif command.name == "zoom":
            self.orbit = self.orbit.zoomed(*command.numbers)
        else:
            self.orbit = Orbit()
        return True

    def render(self) -> Images:
        """Return the present image of every view that is shown."""
        return {view: self._image(view) for view in self.shown}

    def close(self) -> None:
        """Free the renderer."""
        self._rig.close()

    def _image(self, view: str) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        """Return a view's image."""
        if view == FREE:
            frame = self._rig.free(self.orbit, self._size)
        else:
            frame = self._rig.frames(view, self._size, (names.RGB,))[names.RGB]
        return frame.astype(np.uint8, copy=False)
