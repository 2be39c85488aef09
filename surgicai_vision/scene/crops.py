"""Crops: windows of a camera's image around an arm's jaws, and where they lie in it.

    whole = whole_size(crop, fovy, 224, 224)          # height and width of the whole image [pixel]
    window = window_about(crop, point_in_camera, fovy, 224, 224)
    window = window_at(left, top, (224, 224), whole)  # where its corner is known
    renderer.render(data, crop.camera, "rgb", window)

The whole image is so large that `crop.span` at `crop.distance` covers the crop's height. The window
is centred on the projection of a point, rounded to whole pixels, and kept inside the image: if the
point is near the border, or outside, the crop shows the part of the image at that border.

A crop is thus cut out of what the camera sees: it does not turn towards the jaws, and objects
farther from the camera's axis appear as oblique as in the whole image.
"""

import math

from surgicai_vision.core.errors import InputError
from surgicai_vision.core.names import PSM1, PSM2
from surgicai_vision.scene.cameras import (
    BACK,
    DA_VINCI_SIZE,
    ENDOSCOPE,
    FRONT,
    Crop,
    Vector,
    Window,
)

SPAN = 0.050
"""Height of what a crop shows at the holes [m]: at 224 × 224 pixels 0.22 mm per pixel, where
"front" and "back" have 0.43 and 0.47. It holds two and a half needles, with the jaws in the middle.
Of 50, 30 and 20 mm it is the span from which a probe reads the needle's tip best
(`benchmarks/crop_span.py`, docs/envs.md)."""
CROPPED = (0.0, 0.050, 0.075)
"""Point in world [m] at whose distance the span holds: between the holes and the needle's home."""
LARGEST = 16384
"""Largest side of a whole image [pixel]: OpenGL's largest viewport, in Mesa as on GPUs."""
NEAREST = 0.001
"""Least distance of a point along the camera's axis [m], so that none lies behind the lens."""


def _crops(camera: str, stand: Vector, aspect: float) -> tuple[Crop, Crop]:
    """Return the crops around psm1 and psm2 of a camera at the world point `stand` [m]."""
    distance = math.dist(stand, CROPPED)
    first, second = (Crop(camera, arm, distance, SPAN, aspect) for arm in (PSM1, PSM2))
    return first, second


_SURGICAI = 640 / 480
_DA_VINCI = DA_VINCI_SIZE[1] / DA_VINCI_SIZE[0]
FRONT_PSM1, FRONT_PSM2 = _crops("front", FRONT.position, _SURGICAI)
BACK_PSM1, BACK_PSM2 = _crops("back", BACK.position, _SURGICAI)
# The crops of both eyes have one scale: that of the midpoint between them.
ENDO_LEFT_PSM1, ENDO_LEFT_PSM2 = _crops("endo_left", ENDOSCOPE, _DA_VINCI)
ENDO_RIGHT_PSM1, ENDO_RIGHT_PSM2 = _crops("endo_right", ENDOSCOPE, _DA_VINCI)


def whole_size(crop: Crop, fovy: float, height: int, width: int) -> tuple[int, int]:
    """Return the height and width [pixel] of the whole image of which a crop is a part.

    Args:
        crop: the crop.
        fovy: the camera's vertical field of view [rad].
        height: of the crop [pixel].
        width: of the crop [pixel].

    Raises:
        InputError: the crop is larger than the image it is cut from, or that image has too many
            pixels.
    """
    seen = 2.0 * crop.distance * math.tan(fovy / 2.0)
    whole = round(height * seen / crop.span)
    across = round(whole * crop.aspect)
    if whole < height or across < width:
        raise InputError(
            f"A crop of {height} × {width} pixels that spans {crop.span * 1e3:g} mm does not fit "
            f"into the image of '{crop.camera}', which is {whole} × {across} at that resolution; "
            "use a smaller span or a narrower image."
        )
    if max(whole, across) > LARGEST:
        raise InputError(
            f"A crop of {height} × {width} pixels that spans {crop.span * 1e3:g} mm is cut from "
            f"an image of {whole} × {across}; at most {LARGEST} per side can be drawn; use a "
            "larger span or a smaller image."
        )
    return whole, across


def window_about(crop: Crop, point: Vector, fovy: float, height: int, width: int) -> Window:
    """Return the window of a crop around a point.

    Args:
        crop: the crop.
        point: in the frame of the camera, OpenCV's axes [m].
        fovy: the camera's vertical field of view [rad].
        height: of the crop [pixel].
        width: of the crop [pixel].

    Raises:
        InputError: the crop is larger than the image it is cut from.
    """
    whole, across = whole_size(crop, fovy, height, width)
    focal = whole / 2.0 / math.tan(fovy / 2.0)
    x, y, z = point
    scale = focal / max(z, NEAREST)
    left = scale * x + (across - width) / 2.0
    top = scale * y + (whole - height) / 2.0
    return window_at(left, top, (height, width), (whole, across))


def window_at(left: float, top: float, size: tuple[int, int], whole: tuple[int, int]) -> Window:
    """Return the window of a crop, rounded to whole pixels and kept inside the image.

    Args:
        left: where its left edge should be in the whole image [pixel].
        top: the same of its upper edge [pixel].
        size: height and width of the crop [pixel].
        whole: height and width of the whole image [pixel], not smaller.
    """
    lowest, rightmost = (of - part for of, part in zip(whole, size, strict=True))
    return Window(min(max(round(left), 0), rightmost), min(max(round(top), 0), lowest), *whole)
