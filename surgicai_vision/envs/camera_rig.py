"""Camera rig: what an env's cameras see.

There is one renderer at a time; it is made on first use, hence in the worker that uses it.
"""

import mujoco

from surgicai_vision.core import names
from surgicai_vision.envs.observation import ObservationConfig
from surgicai_vision.scene.rendering import Frame, FrameRenderer


class Images:
    """What the cameras of one env see."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._renderer: FrameRenderer | None = None

    def look(self, data: mujoco.MjData, view: ObservationConfig) -> dict[str, Frame]:
        """Return the frames of an observation by `names.frame_key`."""
        renderer = self._sized(view.image_size)
        frames: dict[str, Frame] = {}
        for camera in view.cameras:
            for modality, frame in renderer.render_all(data, camera, view.modalities).items():
                frames[names.frame_key(camera, modality)] = frame
        return frames

    def image(self, data: mujoco.MjData, camera: str, size: tuple[int, int]) -> Frame:
        """Return one RGB image, (height, width, 3) uint8."""
        return self._sized(size).render(data, camera, names.RGB)

    def close(self) -> None:
        """Free the renderer; the next image makes a new one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _sized(self, size: tuple[int, int]) -> FrameRenderer:
        if self._renderer is None or (self._renderer.height, self._renderer.width) != size:
            self.close()
            self._renderer = FrameRenderer(self._model, *size)
        return self._renderer
