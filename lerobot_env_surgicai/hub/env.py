"""Suturing tasks of surgicai-vision for LeRobot's EnvHub.

    from lerobot.envs.factory import make_env
    envs = make_env("<user>/<repository>", n_envs=4, trust_remote_code=True)
    envs["handoff"][0].reset(seed=[0, 1, 2, 3])

Needs `pip install surgicai-vision lerobot_env_surgicai`. This file holds no scene and no weights:
everything it runs is in those two distributions.
"""

from gymnasium.vector import VectorEnv
from lerobot.envs.configs import EnvConfig
from lerobot_env_surgicai.environment import SUBTASKS, SurgicaiEnv


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: EnvConfig | None = None
) -> dict[str, dict[int, VectorEnv]]:
    """Return {task: {0: envs side by side}}.

    Args:
        n_envs: envs of each task.
        use_async_envs: each in a process of its own.
        cfg: a `SurgicaiEnv`, or another configuration whose `task` names tasks between commas; all
            five subtasks without one.
    """
    if isinstance(cfg, SurgicaiEnv):
        return cfg.create_envs(n_envs, use_async_envs)
    named = (cfg.task or "") if cfg is not None else ""
    tasks = [name.strip() for name in named.split(",") if name.strip()] or list(SUBTASKS)
    return SurgicaiEnv(tasks=tasks).create_envs(n_envs, use_async_envs)
