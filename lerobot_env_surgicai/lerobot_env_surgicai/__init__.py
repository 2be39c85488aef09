"""LeRobot plug-in: importing it registers env type `surgicai`, policy type `surgicai_bc` and the
gymnasium ids.

`lerobot-train` and `lerobot-eval` import every distribution called `lerobot_env_…`, and so does a
worker process that is handed an env of ours; nothing else is needed.
"""

from lerobot_env_surgicai.configuration_surgicai_bc import SurgicaiBcConfig
from lerobot_env_surgicai.environment import SurgicaiEnv

__all__ = ["SurgicaiBcConfig", "SurgicaiEnv"]
