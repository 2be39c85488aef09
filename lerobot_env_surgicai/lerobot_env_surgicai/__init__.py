"""LeRobot plug-in: importing it registers the env `surgicai` and two policies.

They are `surgicai_bc` and `surgicai_checkpoint`. The gymnasium ids come with them. `lerobot-train`
and `lerobot-eval` import every distribution called `lerobot_env_…`, and so does a worker process
that is handed an env of ours.
"""

from lerobot_env_surgicai.configuration_surgicai_bc import SurgicaiBcConfig
from lerobot_env_surgicai.configuration_surgicai_checkpoint import SurgicaiCheckpointConfig
from lerobot_env_surgicai.environment import SurgicaiEnv

__all__ = ["SurgicaiBcConfig", "SurgicaiCheckpointConfig", "SurgicaiEnv"]
