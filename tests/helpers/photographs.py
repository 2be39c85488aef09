"""Images for the tests of encoders."""

from pathlib import Path

import numpy as np


def hopper() -> np.ndarray:
    """The photograph of Grace Hopper that matplotlib ships, (1, 224, 224, 3) uint8 RGB."""
    import cv2
    import matplotlib.cbook

    image = cv2.imread(str(matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))
    assert image is not None
    return cv2.resize(image[:512, :512, ::-1], (224, 224), interpolation=cv2.INTER_AREA)[None]


def photograph(name: str) -> np.ndarray:
    """A photograph of tests/helpers/images, (1, 224, 224, 3) uint8 RGB."""
    import cv2

    image = cv2.imread(str(Path(__file__).parent / "images" / f"{name}.jpg"))
    assert image is not None and image.shape == (224, 224, 3)
    return np.ascontiguousarray(image[None, ..., ::-1])
