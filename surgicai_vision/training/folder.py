"""The folder of a training: its request, and the state from which it resumes.

    with training_in(out, request) as done:    # refuses another training's folder
        if done is not None:
            return done
        …
        write_state(out, state)    # periodically; a kill loses only what came since
        state = read_state(out)    # None if there is no complete one
        …                          # the checkpoint is written; the state is removed

A state is plain data and tensors; reading it runs no code. Its file begins with the sha256 of what
follows, so a file that is damaged or was written by something else is not a complete state.
"""

import hashlib
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.files import (
    check_output,
    locked,
    read_json,
    remove_partial,
    write_bytes,
    write_json,
)
from surgicai_vision.core.untrusted import checked
from surgicai_vision.training.checkpoint import (
    CARD,
    LOCK,
    REQUEST,
    WEIGHTS,
    Checkpoint,
    read_checkpoint,
)

STATE = "training_state.pt"
DIGEST_BYTES = hashlib.sha256().digest_size


@contextmanager
def training_in(out: Path, request: Mapping[str, object]) -> Iterator[Checkpoint | None]:
    """Yield the checkpoint of a finished training, or None while this process holds the folder.

    The folder is made, or that of the same request continued: what a killed training left
    unfinished in it is cleared, and the state is removed once the training has ended.

    Args:
        out: the checkpoint folder.
        request: everything that decides the result, as plain data.

    Raises:
        OutputExists: `out` holds something else.
        InputError: another process is training into it.
    """
    if (done := finished_training(out, request)) is not None:
        yield done
        return
    out.mkdir(parents=True, exist_ok=True)
    refusal = InputError(
        f"Another run is training into {out}; wait for it, stop it or give another --out."
    )
    with locked(out / LOCK, refusal=refusal):
        done = finished_training(out, request)  # another process may have finished it meanwhile
        if done is None:
            for folder in (out, *out.glob("epochs/*")):
                remove_partial(folder, (REQUEST, STATE, WEIGHTS, CARD))
            write_json(out / REQUEST, request)
        yield done
        _remove_state(out)


def finished_training(out: Path, request: Mapping[str, object]) -> Checkpoint | None:
    """Return the checkpoint of a finished training; None if there is something left to train.

    Args:
        out: the checkpoint folder, which need not exist.
        request: everything that decides the result, as plain data.

    Raises:
        OutputExists: `out` holds something else.
    """
    check_output(out, may_resume=REQUEST, ours=(LOCK,))
    if (out / REQUEST).exists() and read_json(out / REQUEST) != request:
        raise _another(out)
    if not (out / CARD).exists():
        return None
    checkpoint = read_checkpoint(out)
    with suppress(OSError):  # left by a process that was killed after its last write
        _remove_state(out)
    return checkpoint


def check_part(out: Path, part: Mapping[str, object]) -> None:
    """Refuse a folder whose training differs in some of what decides its result.

    For callers that do not know the whole request before they begin.

    Raises:
        OutputExists: it differs.
    """
    if not (out / REQUEST).exists():
        return
    recorded = checked(read_json(out / REQUEST), dict, str(out / REQUEST))
    if any(recorded.get(key) != value for key, value in part.items()):
        raise _another(out)


def _another(out: Path) -> OutputExists:
    """Return the refusal of a folder that holds another training."""
    return OutputExists(
        f"--out {out} holds another training; give a folder that does not exist yet."
    )


def write_state(out: Path, state: Mapping[str, Any]) -> None:
    """Write the state from which a training resumes, atomically."""
    content = io.BytesIO()
    torch.save(dict(state), content)
    written = content.getvalue()
    write_bytes(out / STATE, hashlib.sha256(written).digest() + written)


def read_state(out: Path) -> dict[str, Any] | None:
    """Return the state from which a training resumes, on the CPU; None if none is complete."""
    try:
        content = (out / STATE).read_bytes()
    except OSError:
        return None
    digest, written = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
    if hashlib.sha256(written).digest() != digest:
        return None
    state: dict[str, Any] = torch.load(io.BytesIO(written), map_location="cpu", weights_only=True)
    return state


def _remove_state(out: Path) -> None:
    """Remove the state of a training that is finished."""
    (out / STATE).unlink(missing_ok=True)
