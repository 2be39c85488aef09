"""Image-based imitation learning for robotic suturing.

The stages and their names: scene → env → demos → dataset → features → policy → evaluation → report.
Importing this package registers the gymnasium ids, one per task. `register_encoder`,
`register_policy`, `register_task`, `register_camera` and `register_engine` add your own parts in
this process; docs/extending.md says how a distribution offers parts in every process.
"""

from typing import TYPE_CHECKING

from surgicai_vision.core.plugins import resolve
from surgicai_vision.core.tasks import register_ids

if TYPE_CHECKING:
    from surgicai_vision.core.cameras import register_camera
    from surgicai_vision.core.executor.engines import register_engine
    from surgicai_vision.core.tasks import register_task
    from surgicai_vision.features.encoders import register_encoder
    from surgicai_vision.training.policies import register_policy

__all__ = [
    "register_camera",
    "register_encoder",
    "register_engine",
    "register_policy",
    "register_task",
]
__version__ = "0.2.0"

_PLACES = {
    "register_camera": "surgicai_vision.core.cameras",
    "register_encoder": "surgicai_vision.features.encoders",
    "register_engine": "surgicai_vision.core.executor.engines",
    "register_policy": "surgicai_vision.training.policies",
    "register_task": "surgicai_vision.core.tasks",
}


def __getattr__(name: str) -> object:
    """Import a function of `__all__` on first use."""
    if name not in _PLACES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return resolve(f"{_PLACES[name]}:{name}")


def __dir__() -> list[str]:
    """List the imported names and those that are imported on first use."""
    return sorted({*globals(), *__all__})


register_ids()
