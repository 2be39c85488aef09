"""Where a training's losses are drawn: TensorBoard or Weights & Biases, where they are installed."""

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from surgicai_vision.errors import InputError

LOGS = ("auto", "tensorboard", "wandb", "none")
"""`auto` is TensorBoard where it is installed. Nothing is sent anywhere unless `wandb` is asked for."""

Log = Callable[[int, dict[str, float]], None]


def installed(package: str) -> bool:
    """Say whether a package can be imported, without importing it."""
    return importlib.util.find_spec(package) is not None


@contextmanager
def open_log(kind: str, out: Path) -> Iterator[Log | None]:
    """Yield what takes (epoch, losses by name), or None.

    Args:
        kind: one of `LOGS`.
        out: the checkpoint folder; TensorBoard writes into `<out>-tensorboard`.

    Raises:
        InputError: what was asked for by name is not installed.
    """
    if kind in ("tensorboard", "wandb") and not installed(kind):
        raise InputError(f"--log {kind}: the package {kind} is not installed; install it, or give --log none.")
    if kind == "wandb":
        import wandb

        with wandb.init(project="surgicai-vision", name=out.name) as run:
            yield lambda epoch, losses: run.log({f"loss/{name}": value for name, value in losses.items()}, step=epoch)
    elif kind == "tensorboard" or (kind == "auto" and installed("tensorboard")):
        yield from _tensorboard(out.with_name(f"{out.name}-tensorboard"))
    else:
        yield None


def _tensorboard(folder: Path) -> Iterator[Log]:
    """Yield a log that writes for TensorBoard; its folder is made with the first losses."""
    from torch.utils.tensorboard import SummaryWriter

    writers: list[SummaryWriter] = []

    def log(epoch: int, losses: dict[str, float]) -> None:
        if not writers:
            writers.append(SummaryWriter(str(folder)))
        for name, value in losses.items():
            writers[0].add_scalar(f"loss/{name}", value, epoch)

    try:
        yield log
    finally:
        for writer in writers:
            writer.close()
