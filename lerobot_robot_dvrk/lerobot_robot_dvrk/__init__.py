"""LeRobot plug-in: importing it registers the robot `dvrk` and the teleoperator `surgicai_page`.

`lerobot-teleoperate`, `lerobot-record` and `lerobot-rollout` import every distribution named
`lerobot_robot_…`.
"""

from lerobot_robot_dvrk.config_dvrk import DvrkConfig
from lerobot_robot_dvrk.config_surgicai_page import SurgicaiPageConfig
from lerobot_robot_dvrk.dvrk import Dvrk
from lerobot_robot_dvrk.surgicai_page import SurgicaiPage

__all__ = ["Dvrk", "DvrkConfig", "SurgicaiPage", "SurgicaiPageConfig"]
