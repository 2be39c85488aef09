"""Board: the latest observation of this process's robot, for a teleoperator that shows it.

LeRobot gives a teleoperator no access to the robot, but the operator's page must show the robot's
images and know which arm is active.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass
class Board:
    """The latest observation.

    Attributes:
        images: view → (height, width, 3).
        arm: the active arm, "" before a robot is connected.
        jaw: one finger's angle in the active arm's set point [rad].
        message: message for the operator.
        success: the served simulation judges that the task has succeeded.
    """

    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    arm: str = ""
    jaw: float = 0.0
    message: str = ""
    success: bool = False


BOARD = Board()
"""The board of this process."""
