"""Where a training's losses are logged: TensorBoard, or Weights & Biases if it is installed."""

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, final

from surgicai_vision.core.errors import InputError

LOGS = ("auto", "tensorboard", "wandb", "none")
"""`auto` is TensorBoard if it is installed. Nothing is sent anywhere unless `wandb` is requested.
"""

Log = Callable[[int, dict[str, float]], None]


def installed(package: str) -> bool:
    """Return True if a package can be imported, without importing it."""
    return importlib.util.find_spec(package) is not None


@contextmanager
def open_log(kind: str, out: Path) -> Iterator[Log | None]:
    """Yield a function of (epoch, losses by name), or None.

    Nothing is opened before the first losses, so running a finished training again logs nothing.

    Args:
        kind: one of `LOGS`.
        out: the checkpoint folder; TensorBoard writes into `<out>-tensorboard`, W&B keeps its files
            next to it.

    Raises:
        InputError: the requested package is not installed, or nobody is logged in to W&B.
    """
    if kind in ("tensorboard", "wandb") and not installed(kind):
        raise InputError(
            f"--log {kind}: the package {kind} is not installed; install it, or give --log none."
        )
    if kind == "wandb":
        _check_login()
        yield from _drawing(_WeightsAndBiases, out)
    elif kind == "tensorboard" or (kind == "auto" and installed("tensorboard")):
        yield from _drawing(_TensorBoard, out)
    else:
        yield None


class _Writer(Protocol):
    """Where losses are logged."""

    def draw(self, epoch: int, losses: Mapping[str, float]) -> None:
        """Add the losses of an epoch, by name."""

    def close(self) -> None:
        """Write what is left."""


@final
class _TensorBoard:
    """An event file in `<out>-tensorboard`."""

    def __init__(self, out: Path):
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(out.with_name(f"{out.name}-tensorboard")))

    def draw(self, epoch: int, losses: Mapping[str, float]) -> None:
        """Add the losses of an epoch, by name."""
        for name, value in losses.items():
            self._writer.add_scalar(name, value, epoch)

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()


@final
class _WeightsAndBiases:
    """A run of the project `surgicai-vision`."""

    def __init__(self, out: Path):
        import wandb

        self._run = wandb.init(project="surgicai-vision", name=out.name, dir=str(out.parent))

    def draw(self, epoch: int, losses: Mapping[str, float]) -> None:
        """Add the losses of an epoch, by name."""
        self._run.log(dict(losses), step=epoch)

    def close(self) -> None:
        """Write what is left."""
        self._run.finish()


def _drawing(open_writer: Callable[[Path], _Writer], out: Path) -> Iterator[Log]:
    """Yield a log that opens its writer at the first losses; close the writer at the end."""
    writers: list[_Writer] = []

    def log(epoch: int, losses: dict[str, float]) -> None:
        if not writers:
            writers.append(open_writer(out))
        writers[0].draw(epoch, {f"loss/{name}": value for name, value in losses.items()})

    try:
        yield log
    finally:
        for writer in writers:
            writer.close()


def _check_login() -> None:
    """Refuse W&B without a login, unless WANDB_MODE=offline keeps the run on this machine."""
    import wandb

    if wandb.setup().settings.mode == "online" and not wandb.api.is_authenticated:
        raise InputError(
            "--log wandb: nobody is logged in; run `wandb login`, or set WANDB_MODE=offline."
        )
