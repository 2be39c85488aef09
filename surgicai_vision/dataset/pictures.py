"""Picture codecs, lossless: RGB and segmentation as PNG, depth as float32 TIFF in metres."""

from typing import Any

import cv2
import numpy as np

from surgicai_vision.errors import BadFile

PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
"""Run lengths after the filter: on a textured scene as fast as zlib's first level (2.4 ms at 224 × 224) and 5 %
smaller; level 6 is 5 % smaller again and takes five times as long."""


def encode(frame: np.ndarray) -> bytes:
    """Encode (H, W, 3) uint8 RGB as PNG, (H, W, 1) uint8 as PNG of three equal channels, float32 as TIFF."""
    if frame.dtype == np.float32:
        # Uncompressed TIFF: the parquet column around it is compressed, which is faster and smaller.
        done, content = cv2.imencode(".tiff", frame, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    else:
        picture = np.repeat(frame, 3, axis=2) if frame.shape[2] == 1 else cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
        done, content = cv2.imencode(".png", picture, PNG)
    assert done
    return content.tobytes()


def decode(content: Any, where: str) -> np.ndarray:
    """Decode the buffer of a picture to (H, W, 3) uint8 RGB or (H, W, 1) float32.

    Raises:
        BadFile: not a picture; `where` says which.
    """
    frame = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    if frame is None:
        raise BadFile(f"{where}: its picture cannot be decoded.")
    if frame.ndim == 2:
        return frame[..., None]
    return cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
