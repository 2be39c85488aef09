"""Video: write images as an MP4 that browsers play, whole or not at all.

    write_video(path, frames, fps=25)   # frames: any iterable of (height, width, 3) uint8 RGB
    read_video(path)                    # (n, height, width, 3)
    write_animation(path, frames, fps)  # an animated WebP, for a README

H.264 by PyAV, in one thread and with no date inside: the same frames give the same bytes. (A
dataset's videos are separate: `dataset.video` reads them in random order.)
"""

import itertools
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import files
from surgicai_vision.core.errors import BadFile, InputError, first_line

Image = NDArray[np.uint8]
"""RGB, (height, width, 3)."""

SUFFIX: Final = ".mp4"
ANIMATION: Final = ".webp"
PIXELS: Final = "yuv420p"
"""The only pixel format of H.264 that every browser plays; it needs even sides."""
REPEATABLE: Final = {"x264-params": "mbtree=0"}
"""x264 without its macroblock tree, which for most image sizes reads uninitialised memory, so that
the bytes of a video differ from run to run."""
OPTIONS: Final = {"crf": "20", "preset": "veryfast", "threads": "1", "g": "50", **REPEATABLE}
"""Options of x264: visually clean, with a key frame every 50 frames for seeking."""
CONTAINER: Final = {"movflags": "+faststart", "fflags": "+bitexact"}
"""The index comes before the images, so that a page plays while it loads; no date, no version."""


def write_video(path: Path, frames: Iterable[Image], fps: float) -> int:
    """Write frames as a video and return their number.

    Args:
        path: the file, `*.mp4`; its folder is created if missing, an earlier file is replaced.
        frames: RGB images (height, width, 3) uint8 of one size with even sides.
        fps: frames per second.

    Raises:
        InputError: no frames, sides that are odd or differ, or a path that is not `.mp4`.
    """
    import av

    if path.suffix != SUFFIX:
        raise InputError(f"{path} is not a {SUFFIX} file; videos are written as MP4.")
    rest = iter(frames)
    first = next(rest, None)
    if first is None:
        raise InputError(f"{path}: there are no frames to write.")
    height, width, _ = first.shape
    if height % 2 or width % 2:
        raise InputError(f"{path}: frames of {height} × {width} pixels; both sides must be even.")
    with (
        files.whole_file(path) as temporary,
        av.open(str(temporary), "w", format="mp4", options=dict(CONTAINER)) as container,
    ):
        rate = Fraction(fps).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=rate, options=dict(OPTIONS))
        assert isinstance(stream, av.VideoStream)
        stream.width = width
        stream.height = height
        stream.pix_fmt = PIXELS
        count = 0
        for frame in itertools.chain((first,), rest):
            if frame.shape != first.shape:
                raise InputError(
                    f"{path}: frame {count} has shape {frame.shape}, the first {first.shape}; "
                    "all frames of a video have the same size."
                )
            image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            container.mux(stream.encode(image))
            count += 1
        container.mux(stream.encode())
    return count


def read_video(path: Path) -> NDArray[np.uint8]:
    """Return all frames of a video, (n, height, width, 3) RGB.

    Raises:
        BadFile: it cannot be decoded.
    """
    import av

    try:
        with av.open(str(path)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except (OSError, av.FFmpegError, IndexError) as error:
        raise BadFile(f"{path} cannot be decoded ({first_line(error)}).") from None
    return np.asarray(np.stack(frames), np.uint8)


def write_animation(
    path: Path, frames: Iterable[Image], fps: float, quality: int = 60, effort: int = 6
) -> int:
    """Write frames as an animated WebP, which needs no player, and return their number.

    Args:
        path: the file, `*.webp`; its folder is created if missing.
        frames: RGB images (height, width, 3) uint8 of one size.
        fps: frames per second.
        quality: of the images, 0 to 100.
        effort: 0 (quick) to 6 (small file).

    Raises:
        InputError: no frames, or a path that is not `.webp`.
    """
    from PIL import Image as Pillow

    if path.suffix != ANIMATION:
        raise InputError(f"{path} is not a {ANIMATION} file; animations are written as WebP.")
    images = [Pillow.fromarray(np.ascontiguousarray(frame)) for frame in frames]
    if not images:
        raise InputError(f"{path}: there are no frames to write.")
    with files.whole_file(path) as temporary:
        images[0].save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=images[1:],
            duration=round(1000 / fps),
            loop=0,
            quality=quality,
            method=effort,
        )
    return len(images)
