"""Settings of `dvrk`: a da Vinci Research Kit over CRTK, as a LeRobot robot."""

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig

from lerobot_robot_dvrk.actions import ACTIONS, INCREMENTS, LEADER
from surgicai_vision.core import names
from surgicai_vision.core.cameras import check_camera
from surgicai_vision.core.config import STEPS
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.demos.imports.rosbag.config import Frames
from surgicai_vision.robot.arm import FINGER_SHARE
from surgicai_vision.robot.driver import DriveConfig
from surgicai_vision.robot.guards import GuardConfig
from surgicai_vision.robot.topics import check_topic

CLOCKS = ("real", "stepped")


@RobotConfig.register_subclass("dvrk")
@dataclass(kw_only=True)
class DvrkConfig(RobotConfig):  # type: ignore[misc]  # mypy skips LeRobot
    """Settings of `dvrk`; guards, topics, frames and jaw_scale are those of `robot drive`.

    Attributes:
        task: decides the active arm; in the whole procedure, the served simulation decides it.
        action: kind of action, a key of `actions.ACTIONS`.
        step: preset of the largest step of one action.
        leader: joint of a leader arm → direction in which it moves the tip (`actions`), if `action`
            is "leader".
        views: views whose images are read.
        image_size: height and width of the images [pixel].
        simulated: the robot is `robot serve`, which begins episodes and judges them.
        send: send the commands that the guards let through; to a served simulation they are always
            sent.
        clock: "real", or "stepped" if the simulation is served with --clock stepped.
        seed: seed of the simulation's first start.
        reset_after: time after a success at which the simulation's next start begins [s]; 0: only
            on request.
        dead_man: sensor_msgs/Joy topic of the switch that a person holds; a served simulation needs
            none.
        compressed: read compressed images.
        guards: limits that cannot be switched off.
        topics: our topic → the robot's own name for it.
        frames: the robot's frames, if they differ from ours.
        jaw_scale: ratio of one finger's angle to the robot's jaw angle.
        transport: library that carries the messages.
        interface: the network interface.
        domain: the ROS domain number.
    """

    task: str = "grasp"
    action: str = INCREMENTS
    step: str = "paper"
    leader: dict[str, str] = field(default_factory=lambda: dict(LEADER))
    views: list[str] = field(default_factory=lambda: ["front", "back"])
    image_size: int = 224
    simulated: bool = False
    send: bool = False
    clock: str = "real"
    seed: int = names.TRAIN_SEED
    reset_after: float = 1.0
    dead_man: str = ""
    compressed: bool = False
    guards: GuardConfig = field(default_factory=GuardConfig)
    topics: dict[str, str] = field(default_factory=dict)
    frames: Frames = field(default_factory=Frames)
    jaw_scale: float = FINGER_SHARE
    transport: str = "cyclonedds"
    interface: str = "lo"
    domain: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_name("task", self.task, names.TASKS)
        check_name("action", self.action, ACTIONS)
        check_name("step preset", self.step, STEPS)
        check_name("clock", self.clock, CLOCKS)
        for view in self.views:
            check_camera(view)
        if self.task == names.SUTURE and not self.simulated:
            raise InputError(
                "for the whole procedure, only a served simulation says which arm is active; give "
                "the subtask."
            )
        if not self.simulated and not self.dead_man.startswith("/"):
            raise InputError(
                "a real robot needs a dead-man's switch: dead_man must be a Joy topic, /NAME."
            )
        if self.dead_man:
            check_topic(self.dead_man, "dead_man")
        self.drive_config()

    def drive_config(self) -> DriveConfig:
        """Return how the robot is driven.

        Raises:
            InputError: a real robot has no workspace in `guards`, or a stepped clock.
        """
        sends = self.send or self.simulated
        return DriveConfig(self.guards, sends, self.simulated, self.clock == "stepped")
