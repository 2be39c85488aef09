"""Where a training's losses are drawn: TensorBoard, or Weights & Biases where it is installed."""

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surgicai_vision.core.errors import InputError

LOGS = ("auto", "tensorboard", "wandb", "none")
"""`auto` is TensorBoard where it is installed. Nothing is sent anywhere unless `wandb` is asked
for.
"""

Log = Callable[[int, dict[str, float]], None]


def installed(package: str) -> bool:
    """Say whether a package can be imported, without importing it."""
    return importlib.util.find_spec(package) is not None


@contextmanager
def open_log(kind: str, out: Path) -> Iterator[Log | None]:
    """Yield what takes (epoch, losses by name), or None.

    Nothing is opened before the first losses: a training that is done draws nothing.

    Args:
        kind: one of `LOGS`.
        out: the checkpoint folder; TensorBoard writes into `<out>-tensorboard`, W&B keeps its files
            beside it.

    Raises:
        InputError: what was asked for by name is not installed, or nobody is logged in to W&B.
    """
    if kind in ("tensorboard", "wandb") and not installed(kind):
        raise InputError(
            f"--log {kind}: the package {kind} is not installed; install it, or give --log none."
        )
    if kind == "wandb":
        _check_login()
        yield from _drawing(
            lambda: _wandb(out), lambda run, losses, epoch: run.log(losses, step=epoch), "finish"
        )
    elif kind == "tensorboard" or (kind == "auto" and installed("tensorboard")):
        yield from _drawing(lambda: _tensorboard(out), _add_scalars, "close")
    else:
        yield None


def _drawing(
    start: Callable[[], Any], draw: Callable[[Any, dict[str, float], int], None], end: str
) -> Iterator[Log]:
    """Yield a log that starts its writer with the first losses and ends it by the method `end`."""
    writers: list[Any] = []

    def log(epoch: int, losses: dict[str, float]) -> None:
        if not writers:
            writers.append(start())
        draw(writers[0], {f"loss/{name}": value for name, value in losses.items()}, epoch)

    try:
        yield log
    finally:
        for writer in writers:
            getattr(writer, end)()


def _tensorboard(out: Path) -> Any:
    """Open an event file in `<out>-tensorboard`."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(out.with_name(f"{out.name}-tensorboard")))


def _add_scalars(writer: Any, losses: dict[str, float], epoch: int) -> None:
    for name, value in losses.items():
        writer.add_scalar(name, value, epoch)


def _check_login() -> None:
    """Refuse W&B without an account before any work; `WANDB_MODE=offline` keeps a run on this
    machine.
    """
    import wandb

    if wandb.setup().settings.mode == "online" and not wandb.api.is_authenticated:
        raise InputError(
            "--log wandb: nobody is logged in; run `wandb login`, or set WANDB_MODE=offline."
        )


def _wandb(out: Path) -> Any:
    """Start a run."""
    import wandb

    return wandb.init(project="surgicai-vision", name=out.name, dir=str(out.parent))
