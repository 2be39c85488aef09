"""Videos of a LeRobot dataset: frames by number, written and read with PyAV.

Every second frame is a key frame, because policies read frames in random order.
"""

from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import BadFile, first_line
from surgicai_vision.core.processes import kept_schedule
from surgicai_vision.core.video import REPEATABLE

if TYPE_CHECKING:
    import av

CODECS = MappingProxyType(
    {
        "h264": ("libx264", {"g": "2", "crf": "30", **REPEATABLE}),
        "av1": ("libsvtav1", {"g": "2", "crf": "30", "preset": "12"}),
    }
)
"""Codec → (encoder, options): LeRobot's defaults (lerobot 0.6.1, configs/video.py), except that
the same frames give the same bytes."""

PIXELS = "yuv420p"
AV1_SIZE = 32
"""Smallest image side of an av1 video [px]: SVT-AV1 kills the process at 24 px or less."""


class VideoWriter:
    """A video file that is being written.

    Attributes:
        written: bytes encoded so far.
    """

    def __init__(self, path: Path, codec: str, fps: int, size: int):
        import av

        name, options = CODECS[codec]
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), "w")
        stream = self._container.add_stream(name, rate=fps, options=dict(options))
        assert isinstance(stream, av.VideoStream)  # CODECS names video encoders only
        stream.width = size
        stream.height = size
        stream.pix_fmt = PIXELS
        with kept_schedule():  # SVT-AV1 changes it when running as root
            stream.codec_context.open()
        self._stream = stream
        self.written = 0

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame, (H, W, 3) uint8 RGB."""
        import av

        image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        self._mux(self._stream.encode(image))

    def close(self) -> None:
        """Write the remaining frames of the encoder, and the file's index."""
        self._mux(self._stream.encode())
        self._container.close()

    def _mux(self, packets: "list[av.Packet]") -> None:
        self.written += sum(packet.size for packet in packets)
        self._container.mux(packets)

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: object, trace: TracebackType | None
    ) -> None:
        self.close() if kind is None else self._container.close()


def read_frames(
    path: Path, first: int, count: int, fps: float
) -> Iterator[NDArray[np.uint8 | np.float32]]:
    """Yield the frames first … first + count - 1 of a video, each (H, W, 3) uint8 RGB.

    Raises:
        BadFile: the video cannot be decoded, or a frame is missing.
    """
    import av

    wanted = first
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            # For such small frames, decoding slices in threads costs more than it gains.
            stream.thread_type = "NONE"
            if first and stream.time_base:
                container.seek(int(first / fps / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                number = round(frame.time * fps)
                if number < wanted:
                    continue
                if number > wanted:
                    break
                yield np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
                wanted += 1
                if wanted == first + count:
                    return
    except (OSError, av.FFmpegError, IndexError, TypeError, OverflowError) as error:
        raise BadFile(f"{path}: frame {wanted} cannot be decoded ({first_line(error)}).") from None
    if wanted < first + count:
        raise BadFile(f"{path} has no frame {wanted}.")


def count_frames(path: Path) -> int:
    """Return the number of frames in a video, from its packets; 0 if it cannot be read."""
    import av

    count = 0
    try:
        with av.open(str(path)) as container:
            for packet in container.demux(container.streams.video[0]):
                count += packet.pts is not None
    except (OSError, av.FFmpegError, IndexError):
        return 0
    return count
