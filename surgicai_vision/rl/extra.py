"""The extra `rl`: refused in one line where it is not installed."""

import contextlib
import importlib
import importlib.util
import io

from surgicai_vision.core.errors import InputError

PACKAGES = ("stable_baselines3", "sb3_contrib", "d3rlpy", "minari")
"""What the extra brings."""


GYM = "gym"
"""What d3rlpy brings and Stable-Baselines3 imports where it is: gym, gymnasium's predecessor."""


def check_extra(asked: str, *packages: str) -> None:
    """Raise `InputError` where a package of the extra is missing, without importing any.

    Args:
        asked: what was asked for, for the message.
        *packages: what it needs, of `PACKAGES`.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{asked} needs the extra 'rl' ({', '.join(missing)} is not installed): "
            "pip install 'surgicai-vision[rl]'."
        )
    if packages and importlib.util.find_spec(GYM) is not None:
        with contextlib.redirect_stderr(io.StringIO()):  # it prints that nobody maintains it
            importlib.import_module(GYM)
