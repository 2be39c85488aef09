"""LeRobot plug-in: importing it registers the env `surgicai` and two policies.

The policies are `surgicai_bc` and `surgicai_checkpoint`. The gymnasium ids are registered as well.
`lerobot-train` and `lerobot-eval` import every distribution named `lerobot_env_…`; a worker process
that receives one of our envs imports this one.
"""

from lerobot_env_surgicai.configuration_surgicai_bc import SurgicaiBcConfig
from lerobot_env_surgicai.configuration_surgicai_checkpoint import SurgicaiCheckpointConfig
from lerobot_env_surgicai.environment import SurgicaiEnv

__all__ = ["SurgicaiBcConfig", "SurgicaiCheckpointConfig", "SurgicaiEnv"]
