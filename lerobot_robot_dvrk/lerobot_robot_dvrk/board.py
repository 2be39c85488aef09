"""Board: what a robot of this process saw last, for a teleoperator that shows it.

LeRobot hands a teleoperator nothing of the robot; the page that a person looks at must show its
images and know which arm is active.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass
class Board:
    """What was seen last.

    Attributes:
        images: view → (height, width, 3).
        arm: the active arm, "" before a robot is connected.
        jaw: one finger's angle of its set point [rad].
        message: what a person should know.
        success: the served simulation's judge sees success.
    """

    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    arm: str = ""
    jaw: float = 0.0
    message: str = ""
    success: bool = False


BOARD = Board()
"""The one of this process."""
