"""Camera rig: what an env's cameras see, and the crops of their images.

There is one renderer at a time; it is made on first use, hence in the worker that uses it.
"""

from collections.abc import Iterable

from surgicai_vision.core import names
from surgicai_vision.envs.calibration import Calibration
from surgicai_vision.envs.observation import ObservationConfig
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.skin import Skin
from surgicai_vision.scene.cameras import stand
from surgicai_vision.scene.orbit import Orbit
from surgicai_vision.scene.rendering import Frame, FrameRenderer


class Images:
    """What the views of one env show at its present state.

    Args:
        simulation: the env's.
        calibration: says where crops lie.
    """

    def __init__(self, simulation: Simulation, calibration: Calibration):
        self._simulation = simulation
        self.calibration = calibration
        self._renderer: FrameRenderer | None = None
        self._stands: dict[str, str] = {}

    def look(self, view: ObservationConfig) -> dict[str, Frame]:
        """Return the frames of an observation by `names.frame_key`."""
        frames: dict[str, Frame] = {}
        for camera in view.cameras:
            for modality, frame in self.frames(camera, view.image_size, view.modalities).items():
                frames[names.frame_key(camera, modality)] = frame
        return frames

    def frames(
        self,
        view: str,
        size: tuple[int, int],
        modalities: Iterable[str],
        quality: str = "fast",
    ) -> dict[str, Frame]:
        """Return several modalities of a view, images of `size`: height and width [pixel]."""
        renderer = self._sized(size, quality)
        if view not in self._stands:
            self._stands[view] = stand(view)
        camera = self._stands[view]
        window = self.calibration.window(view, size) if camera != view else None
        return renderer.render_all(self._simulation.data, camera, modalities, window)

    def free(self, orbit: Orbit, size: tuple[int, int], quality: str = "fast") -> Frame:
        """Return what a free camera sees, (height, width, 3) uint8."""
        return self._sized(size, quality).render(self._simulation.data, orbit)

    def close(self) -> None:
        """Free the renderer; the next image makes a new one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _sized(self, size: tuple[int, int], quality: str) -> FrameRenderer:
        """Return the renderer of images of `size` in `quality`."""
        renderer = self._renderer
        if renderer is None or (renderer.height, renderer.width, renderer.quality) != (
            *size,
            quality,
        ):
            self.close()
            tissue = self._simulation.tissue
            if tissue is not None and tissue.drawn_skin is None:
                tissue.drawn_skin = Skin(self._simulation, tissue)
            skin = None if tissue is None else tissue.drawn_skin
            renderer = FrameRenderer(self._simulation.model, *size, quality, skin)
            self._renderer = renderer
        return renderer
