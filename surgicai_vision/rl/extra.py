"""The extra `rl`: a one-line refusal where it is not installed."""

import importlib.util

from surgicai_vision.core.errors import InputError

PACKAGES = ("stable_baselines3", "sb3_contrib", "d3rlpy", "minari")
"""What the extra installs."""


def check_extra(asked: str, *packages: str) -> None:
    """Raise `InputError` if a package of the extra is missing, without importing any.

    Args:
        asked: what was requested, for the message.
        *packages: what it needs, from `PACKAGES`.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{asked} needs the extra 'rl' ({', '.join(missing)} is not installed): "
            "pip install 'surgicai-vision[rl]'."
        )
