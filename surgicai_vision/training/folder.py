"""The folder of a training: what was asked for in it, and the state that it goes on from.

    if done := begin(out, request):    # refuses another training's folder
        return done
    …
    write_state(out, state)            # every so often; a kill costs what came since
    state = read_state(out)            # None where there is no whole one
    …
    remove_state(out)                  # the checkpoint is written

A state is plain data and tensors; it is read as such and runs no code.
"""

import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.files import check_output, read_json, write_bytes, write_json
from surgicai_vision.training.checkpoint import CARD, REQUEST, Checkpoint, read_checkpoint

STATE = "training_state.pt"


def begin(out: Path, request: Mapping[str, object]) -> Checkpoint | None:
    """Make a training's folder, or take one of the same request; return what is finished there.

    Args:
        out: the checkpoint folder.
        request: everything that decides the result, as plain data.

    Returns:
        The checkpoint of a finished training; None where there is something to train.

    Raises:
        OutputExists: `out` holds something else.
    """
    check_output(out, may_resume=REQUEST)
    if (out / REQUEST).exists() and read_json(out / REQUEST) != request:
        raise OutputExists(
            f"--out {out} holds another training; give a folder that does not exist yet."
        )
    if (out / CARD).exists():
        return read_checkpoint(out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / REQUEST, request)
    return None


def write_state(out: Path, state: Mapping[str, Any]) -> None:
    """Write what a training goes on from, whole."""
    content = io.BytesIO()
    torch.save(dict(state), content)
    write_bytes(out / STATE, content.getvalue())


def read_state(out: Path) -> dict[str, Any] | None:
    """Return what a training goes on from, on the CPU; None where there is no whole state."""
    try:
        state: dict[str, Any] = torch.load(out / STATE, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError):
        return None
    return state


def remove_state(out: Path) -> None:
    """Remove the state of a training that is finished."""
    (out / STATE).unlink(missing_ok=True)
