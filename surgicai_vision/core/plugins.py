"""Plug-ins: parts that are named by a string and imported on first use."""

import importlib
from typing import Any


def resolve(target: str) -> Any:
    """Import "module:attribute"."""
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
