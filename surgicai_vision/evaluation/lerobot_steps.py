"""Processing steps of a LeRobot checkpoint: which of those that it names may be called."""

import contextlib
import importlib
import sys
from pathlib import Path

from surgicai_vision.core.errors import BadFile, shown
from surgicai_vision.core.files import read_json
from surgicai_vision.core.untrusted import checked

STEPS = ("policy_preprocessor.json", "policy_postprocessor.json")
"""Files that name the steps before and after a policy."""


def check_steps(folder: Path, base: type) -> None:
    """Refuse processing steps that are not classes of LeRobot or of an installed plug-in.

    LeRobot imports and calls a step before it looks at what it is: "subprocess.Popen" runs a
    program. No other module is imported here.

    Args:
        folder: the checkpoint.
        base: LeRobot's `ProcessorStep`, which every step inherits.

    Raises:
        BadFile: a step is something else, or a file that names the steps is damaged or missing.
    """
    for path in (folder / name for name in STEPS):
        table = checked(read_json(path), dict, str(path))
        steps = checked(table.get("steps"), list, f"{path}: steps")
        for step in (checked(step, dict, f"{path}: a step") for step in steps):
            if "registry_name" in step:  # LeRobot looks only there
                continue
            named = checked(step.get("class"), str, f"{path}: the class of a step")
            module, _, name = named.rpartition(".")
            with contextlib.suppress(ImportError, ValueError):
                if module.partition(".")[0] == "lerobot":
                    importlib.import_module(module)
            kind: object = getattr(sys.modules.get(module), name, None)
            if not isinstance(kind, type) or not issubclass(kind, base):
                raise BadFile(
                    f"{path} is refused: {shown(named)} is no processing step of LeRobot or of an "
                    "installed plug-in, and LeRobot would call it."
                )
