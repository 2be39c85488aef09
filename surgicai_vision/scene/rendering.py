"""Rendering: a state becomes images, in software, without a display.

One OpenGL context serves the whole process and lives until it ends; every (model, size, quality)
has one set of GPU objects inside it, shared by its `FrameRenderer`s and freed with the last of
them. Several contexts in one process corrupt each other's segmentation when an older one is
collected late, and cost 50 ms each.

On llvmpipe a frame's time goes into shadows, multisampling and the triangles of capsules, in this
order. Quality "fast" has none of the first two and few of the third; "high" is for images that
people look at.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError, check_name, first_line
from surgicai_vision.core.names import DEPTH, MODALITIES, PARTS, RGB, SEGMENTATION
from surgicai_vision.scene import opengl
from surgicai_vision.scene.cameras import Window, camera_id, crop_of
from surgicai_vision.scene.opengl import renderer_string
from surgicai_vision.scene.orbit import Orbit
from surgicai_vision.scene.reshape import MESH, needle_vertices
from surgicai_vision.scene.visual import appearance

__all__ = ["QUALITIES", "Frame", "FrameRenderer", "parts_of_geoms", "renderer_string"]

Frame = NDArray[np.uint8 | np.float32]
"""One modality of a view, (height, width, channels): uint8, or float32 [m] for depth."""


@dataclass(frozen=True)
class Quality:
    """What decides how much an image costs.

    Multisampling, shadow map [pixel], triangles around and along a capsule, quads per face.
    """

    samples: int
    shadow: int
    slices: int
    stacks: int
    quads: int


QUALITIES = MappingProxyType({"fast": Quality(0, 0, 12, 6, 1), "high": Quality(8, 4096, 32, 16, 4)})
MAX_SIDE = 4096
"""Largest height and width of an image [pixel]."""


class Following(Protocol):
    """Meshes that follow the state, as the skin of soft tissue does (`envs.skin`)."""

    meshes: tuple[int, ...]
    """Their ids."""

    def follow(self) -> tuple[int, ...]:
        """Write the meshes of the current state into the model; return a version of each.

        A mesh whose version has not changed is not uploaded again.
        """


class FrameRenderer:
    """Images of one model at one size. Close it, or use it as a context manager.

    Use a renderer only in the thread and the process that made it.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        height: int,
        width: int,
        quality: str = "fast",
        skin: Following | None = None,
    ):
        """Prepare images of `height` × `width` [pixel] in quality "fast" or "high".

        Args:
            model: the model.
            height: of the images [pixel].
            width: of the images [pixel].
            quality: a key of `QUALITIES`.
            skin: meshes of the model that follow the state, if it has any.

        Raises:
            UnknownName: no such quality.
            InputError: a size outside 1..4096, or no OpenGL on this machine.
        """
        check_name("quality", quality, QUALITIES)
        for side in (height, width):
            if not 1 <= side <= MAX_SIDE:
                raise InputError(
                    f"An image of {height} × {width} pixels; each side must be 1 to {MAX_SIDE}."
                )
        self.model = model
        self.height = int(height)
        self.width = int(width)
        self.quality = quality
        self._skin = skin
        self._cameras: dict[str, mujoco.MjvCamera] = {}
        self._target: _Target | None = _acquire(model, self.height, self.width, quality)

    def render(
        self,
        data: mujoco.MjData,
        camera: str | Orbit,
        modality: str = RGB,
        window: Window | None = None,
    ) -> Frame:
        """Return one image of the state `data`, as a new array.

        Args:
            data: a state that has been through `mj_forward`.
            camera: name of a camera of the model, or a free one; for the image of a crop, its
                camera together with a window.
            modality: "rgb" → (H, W, 3) uint8; "depth" → (H, W, 1) float32 [m] along the camera's
                axis, the far plane where there is nothing; "segmentation" → (H, W, 1) uint8, an
                index of `names.PARTS`.
            window: where the image lies in a larger one of which only this part is drawn.

        Raises:
            UnknownName: no such camera or modality; the message lists what exists.
            InputError: the name of a crop, or a window that is not within its whole image.
        """
        return self.render_all(data, camera, (modality,), window)[modality]

    def render_all(
        self,
        data: mujoco.MjData,
        camera: str | Orbit,
        modalities: Iterable[str],
        window: Window | None = None,
    ) -> dict[str, Frame]:
        """Return several modalities of one view; depth and segmentation share one pass."""
        wanted = tuple(modalities)
        for modality in wanted:
            check_name("modality", modality, MODALITIES)
        area = self._area(window)
        target = self._target
        if target is None:
            raise InputError("This FrameRenderer is closed; make a new one.")
        if target.lost:  # a forked child of the process that made it
            target = self._target = _acquire(self.model, self.height, self.width, self.quality)
        if isinstance(camera, Orbit):
            view = camera.view()
        else:
            view = self._cameras.get(camera) or self._view(camera)
        return target.draw(data, view, wanted, area, self._skin)

    def _area(self, window: Window | None) -> mujoco.MjrRect:
        """Return where the whole image lies relative to what is drawn; OpenGL's rows run up."""
        if window is None:
            return mujoco.MjrRect(0, 0, self.width, self.height)
        right = window.left + self.width
        lower = window.height - window.top - self.height
        if min(window.left, window.top, window.width - right, lower) < 0:
            raise InputError(
                f"An image of {self.height} × {self.width} pixels at row {window.top}, column "
                f"{window.left} is not within {window.height} × {window.width}."
            )
        return mujoco.MjrRect(-window.left, -lower, window.width, window.height)

    def close(self) -> None:
        """Free what no other renderer uses. A second call does nothing."""
        target = getattr(self, "_target", None)
        self._target = None
        if target is not None:
            _release(target)

    def __enter__(self) -> "FrameRenderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self, is_finalizing: Callable[[], bool] = sys.is_finalizing) -> None:
        # At the end of the process all is freed anyway, and this module's names may be gone.
        if not is_finalizing():
            self.close()

    def _view(self, camera: str) -> mujoco.MjvCamera:
        """Return MuJoCo's handle for a camera and keep it."""
        if crop_of(camera) is not None:
            raise InputError(
                f"'{camera}' is a crop, whose position depends on the arm's reported joints; "
                "take its image from an env's rig: envs.camera_rig.Images(env.simulation)."
            )
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = camera_id(self.model, camera)
        self._cameras[camera] = view
        return view


def _context(model: mujoco.MjModel) -> mujoco.MjrContext:
    """Return MuJoCo's GPU objects; refuse if the current context cannot draw."""
    try:
        return mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    except mujoco.FatalError as error:
        raise opengl.no_image(first_line(error).rstrip(".")) from error


class _Target:
    """One model's GPU objects at one size and quality."""

    def __init__(self, key: tuple[int, int, int, str], model: mujoco.MjModel):
        _, height, width, name = key
        quality = QUALITIES[name]
        self.key = key
        self.model = model
        self.users = 0
        self.lost = False
        with _visual_settings(model, quality, height, width):
            self.context = _context(model)
        self.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self.scene = mujoco.MjvScene(model=model, maxgeom=model.ngeom + 100)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = quality.shadow > 0
        self.option = mujoco.MjvOption()
        self.area = mujoco.MjrRect(0, 0, width, height)
        self.colours = np.empty((height, width, 3), dtype=np.uint8)
        self.depths = np.empty((height, width), dtype=np.float32)
        self.parts = parts_of_geoms(model)
        self.codes = np.zeros(0, dtype=np.uint8)
        self.look = appearance.shown(model)
        self.painted = [0.0] * len(self.look)
        self.needle = needle_vertices(model)
        self.drawn_needle = self.needle.copy()
        self.versions: dict[int, int] = {}

    def draw(
        self,
        data: mujoco.MjData,
        view: mujoco.MjvCamera,
        wanted: tuple[str, ...],
        area: mujoco.MjrRect,
        skin: Following | None,
    ) -> dict[str, Frame]:
        """Return the wanted modalities from at most two passes.

        `area` is the viewport. One larger than the framebuffer is a crop: projection and pixels
        are those of the whole image, and what falls outside the framebuffer is not drawn.
        """
        opengl.make_current()
        numbers = self.look.tolist()
        if numbers != self.painted:
            appearance.paint(self.model, self.context)
            self.painted = numbers
            self.codes = np.zeros(0, dtype=np.uint8)
        if not np.array_equal(self.needle, self.drawn_needle):
            mujoco.mjr_uploadMesh(self.model, self.context, self.model.mesh(MESH).id)
            self.drawn_needle = self.needle.copy()
        if skin is not None:
            for mesh, version in zip(skin.meshes, skin.follow(), strict=True):
                if self.versions.get(mesh) != version:
                    mujoco.mjr_uploadMesh(self.model, self.context, mesh)
                    self.versions[mesh] = version
        # Another target may have drawn since; without this its buffer would be drawn on and read.
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, data, self.option, None, view, everything, self.scene)
        images: dict[str, Frame] = {}
        if RGB in wanted:
            mujoco.mjr_render(area, self.scene, self.context)
            mujoco.mjr_readPixels(self.colours, None, self.area, self.context)
            images[RGB] = self.colours[::-1].copy()  # OpenGL's first row is the lowest
        if DEPTH in wanted or SEGMENTATION in wanted:
            self._draw_ids(area)
            if DEPTH in wanted:
                images[DEPTH] = self._depth()
            if SEGMENTATION in wanted:
                images[SEGMENTATION] = self._segmentation()
        return images

    def _draw_ids(self, area: mujoco.MjrRect) -> None:
        """Draw each geom in the colour of its number; such a pass gives the exact depth as well."""
        flags = self.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        try:
            mujoco.mjr_render(area, self.scene, self.context)
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        mujoco.mjr_readPixels(self.colours, self.depths, self.area, self.context)

    def _depth(self) -> NDArray[np.float32]:
        """Return metres from the depth buffer, which has 1 at the near plane and 0 at the far."""
        extent = self.model.stat.extent
        near = self.model.vis.map.znear * extent
        far = self.model.vis.map.zfar * extent
        stored = self.depths[::-1, :, None].astype(np.float64)
        metres: NDArray[np.float64] = near * far / (near + stored * (far - near))
        return metres.astype(np.float32)

    def _segmentation(self) -> NDArray[np.uint8]:
        """Return parts from colours: a geom's number plus 1, in base 256, red first."""
        if (
            len(self.codes) != self.scene.ngeom + 1
        ):  # the same geoms are visible in every frame of a model
            self.codes = np.zeros(self.scene.ngeom + 1, dtype=np.uint8)
            for geom in self.scene.geoms[: self.scene.ngeom]:
                if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                    self.codes[geom.segid + 1] = self.parts[geom.objid]
        code = self.colours[::-1, :, 0:1].astype(np.int32)
        if len(self.codes) > 256:
            code = code + self.colours[::-1, :, 1:2] * 256 + self.colours[::-1, :, 2:3] * 65536
        return self.codes[code]


def parts_of_geoms(model: mujoco.MjModel) -> NDArray[np.uint8]:
    """Return each geom's index in `names.PARTS`, (ngeom,).

    It is decided by the nearest body named after a part, from the geom's own up to the root.
    """
    found = np.zeros(model.ngeom, dtype=np.uint8)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        while body > 0 and not found[geom]:
            prefix = model.body(body).name.split("_")[0]
            found[geom] = PARTS.index(prefix) if prefix in PARTS else 0
            body = int(model.body_parentid[body])
    return found


_targets: dict[tuple[int, int, int, str], _Target] = {}


def _acquire(model: mujoco.MjModel, height: int, width: int, quality: str) -> _Target:
    """Return the target for these arguments; the caller must `_release` it once."""
    key = (id(model), height, width, quality)
    if key not in _targets:
        opengl.make_current()
        _targets[key] = _Target(key, model)
    _targets[key].users += 1
    return _targets[key]


def _release(target: _Target) -> None:
    """Free the target with its last user, in the OpenGL context that made it."""
    target.users -= 1
    if target.users == 0 and not target.lost:
        del _targets[target.key]
        opengl.make_current()
        target.context.free()


def _free_all() -> None:
    """Free every target while OpenGL still exists."""
    for target in tuple(_targets.values()):
        target.users = 1
        _release(target)


def _forget() -> None:
    """Leave the parent's GPU objects alone in a forked child."""
    for target in _targets.values():
        target.lost = True
    _targets.clear()


opengl.before_closing(_free_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


@contextlib.contextmanager
def _visual_settings(
    model: mujoco.MjModel, quality: Quality, height: int, width: int
) -> Iterator[None]:
    """Set, for a while, the options that OpenGL objects are made from; they are read only then."""
    look = model.vis.quality
    screen = model.vis.global_
    settings = (
        (look, "offsamples", quality.samples),
        (look, "shadowsize", quality.shadow),
        (look, "numslices", quality.slices),
        (look, "numstacks", quality.stacks),
        (look, "numquads", quality.quads),
        (screen, "offheight", height),
        (screen, "offwidth", width),
    )
    before = [getattr(group, name) for group, name, _ in settings]
    try:
        for group, name, value in settings:
            setattr(group, name, value)
        yield
    finally:
        for (group, name, _), value in zip(settings, before, strict=True):
            setattr(group, name, value)
