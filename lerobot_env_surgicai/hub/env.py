"""Suturing tasks of surgicai-vision for LeRobot's EnvHub.

    from lerobot.envs.factory import make_env
    envs = make_env("<user>/<repository>", n_envs=4, trust_remote_code=True)
    envs["handoff"][0].reset(seed=[0, 1, 2, 3])

Needs `pip install surgicai-vision lerobot_env_surgicai`. This file contains no scene and no
weights: everything it runs is in those two distributions.
"""

from gymnasium.vector import VectorEnv
from lerobot.envs.configs import EnvConfig
from lerobot_env_surgicai.environment import SUBTASKS, SurgicaiEnv


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: EnvConfig | None = None
) -> dict[str, dict[int, VectorEnv]]:
    """Return {task: {0: vectorised envs}}.

    Args:
        n_envs: envs per task.
        use_async_envs: run each env in a separate process.
        cfg: a `SurgicaiEnv`, or another configuration whose `task` is a comma-separated list of
            tasks; by default all five subtasks.
    """
    if isinstance(cfg, SurgicaiEnv):
        return cfg.create_envs(n_envs, use_async_envs)
    named = (cfg.task or "") if cfg is not None else ""
    tasks = [name.strip() for name in named.split(",") if name.strip()] or list(SUBTASKS)
    return SurgicaiEnv(tasks=tasks).create_envs(n_envs, use_async_envs)
