"""Settings of `surgicai_page`: keyboard and gamepad in a browser as a LeRobot teleoperator."""

from dataclasses import dataclass, field

from lerobot.teleoperators.config import TeleoperatorConfig

from surgicai_vision.core.cameras import check_camera
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.robot.simulated import PSM_NAMES

AXES = ("view", "base")


@TeleoperatorConfig.register_subclass("surgicai_page")
@dataclass(kw_only=True)
class SurgicaiPageConfig(TeleoperatorConfig):  # type: ignore[misc]  # mypy skips LeRobot
    """Settings of `surgicai_page`.

    Attributes:
        port: port of the page on this machine's loopback; 0 for any free one.
        views: views of the robot that the page shows.
        axes: axes that the keys follow: those of the endoscope's "view" or of the arm's "base".
        speed: share of the step size that a key or a full deflection commands.
        step: preset of the largest step of one action; give the same as for the robot.
        arm: the arm assumed until a robot reports which is active, "PSM1" or "PSM2".
    """

    port: int = 8765
    views: list[str] = field(default_factory=lambda: ["front", "back"])
    axes: str = "view"
    speed: float = 0.5
    step: str = "paper"
    arm: str = "PSM2"

    def __post_init__(self) -> None:
        check_name("axes", self.axes, AXES)
        check_name("arm", self.arm, PSM_NAMES)
        for view in self.views:
            check_camera(view)
        if not 0.0 < self.speed <= 1.0:
            raise InputError(f"speed is {self.speed:g}; it must be above 0 and at most 1.")
