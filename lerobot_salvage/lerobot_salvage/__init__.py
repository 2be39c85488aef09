"""Check any LeRobot v3 dataset, and keep the longest whole prefix of a broken one.

from lerobot_salvage import check_dataset, repair_dataset
"""

from lerobot_salvage.check import check_dataset
from lerobot_salvage.repair import Repair, repair_dataset

__all__ = ["Repair", "check_dataset", "repair_dataset"]
