"""Provenance: with what, where and by which command a result was made."""

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.core.files import FAMILIES, code_version

PACKAGES = (
    "surgicai-vision",
    "mujoco",
    "gymnasium",
    "lerobot",
    "torch",
    "timm",
    "numpy",
    "pyarrow",
)


def provenance(render: bool = True) -> dict[str, Any]:
    """Return versions and machine as plain data.

    Args:
        render: also ask for the GL renderer's name, which opens a GL context.
    """
    return {
        "packages": {name: _version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "renderer": _renderer() if render else None,
    }


def episode_code() -> str:
    """Return the version of all code that an episode depends on, the families' included."""
    return f"{code_version()} {code_version(*FAMILIES)}"


def command_line() -> str:
    """Return the command this process was started with, as a user would type it."""
    import shlex

    program = Path(sys.argv[0])
    started = "python -m surgicai_vision" if program.name == "__main__.py" else program.name
    return f"{started} {shlex.join(sys.argv[1:])}".strip()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    """The processor's name as Linux gives it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _renderer() -> str | None:
    """The GL renderer's name, or None where no GL renders."""
    from surgicai_vision.scene.rendering import renderer_string

    try:
        return renderer_string()
    except SurgicaiError:
        return None
