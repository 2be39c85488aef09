"""Pictures for the tests of encoders."""

import numpy as np


def hopper() -> np.ndarray:
    """The photograph of Grace Hopper that matplotlib ships, its upper square, (1, 224, 224, 3) uint8 RGB."""
    import cv2
    import matplotlib.cbook

    picture = cv2.imread(str(matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))
    assert picture is not None
    return cv2.resize(picture[:512, :512, ::-1], (224, 224), interpolation=cv2.INTER_AREA)[None]
