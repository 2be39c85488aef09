"""Where commands read and write by default: below `outputs/` in the current folder."""

import os
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from surgicai_vision.core import files
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, check_name

if TYPE_CHECKING:
    from surgicai_vision.dataset import RenderedDataset
    from surgicai_vision.evaluation.policy_spec import PolicySpec

OUTPUTS = Path("outputs")
CORES = len(os.sched_getaffinity(0))


def demos_folder(task: str) -> Path:
    """Return the folder of a task's demonstrations."""
    return OUTPUTS / "demos" / task


def dataset_folder(task: str) -> Path:
    """Return the folder of a task's dataset."""
    return OUTPUTS / "datasets" / task


def train_folder(task: str, name: str, seed: int) -> Path:
    """Return the checkpoint folder of one training, by the policy's name."""
    return OUTPUTS / "train" / f"{task}-{name}-seed{seed}"


def evaluation_folder(spec: "PolicySpec", seed: int, episodes: int) -> Path:
    """Return the folder of one evaluation of a policy, by its first start and episodes."""
    return OUTPUTS / "evaluations" / f"{spec.folder_name}-starts{seed}+{episodes}"


def robustness_folder(spec: "PolicySpec", seed: int, episodes: int) -> Path:
    """Return the folder of one policy's curves, by its first start and episodes."""
    return OUTPUTS / "robustness" / f"{spec.folder_name}-starts{seed}+{episodes}"


def check_folder(out: Path, marker: str, option: str = "--out", ours: Collection[str] = ()) -> None:
    """Refuse an output folder that cannot be written or holds something else, before any work.

    Args:
        out: the folder to create or continue.
        marker: the file that marks it as ours.
        option: the option that gave the folder, for the message.
        ours: names of files that a killed run may leave without the marker.
    """
    files.check_output(out, may_resume=marker, option=option, ours=ours)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=files.TEMPORARY):
            pass
    except OSError as error:
        raise InputError(
            f"{option} {out} cannot be written: {error.strerror}; choose another folder."
        ) from None


def demos_task(folder: Path) -> str:
    """Read which task a folder of demonstrations shows."""
    from surgicai_vision.demos.store import read_marker

    return str(read_marker(folder)["task"])


def check_task(given: str | None, recorded: str, folder: Path) -> None:
    """Refuse a task that is not the one that the data of a folder show.

    Args:
        given: the option --task; None goes with any data.
        recorded: the data's task.
        folder: where they are, for the message.

    Raises:
        InputError: another task is given.
    """
    if given not in (None, recorded):
        raise InputError(f"--task {given}: {folder} shows {recorded}; leave --task out.")


def open_dataset(folder: Path | None, task: str | None, views: Sequence[str]) -> "RenderedDataset":
    """Open a dataset, by default the task's.

    Args:
        folder: the dataset; None: where `render-demos` puts that of the task.
        task: the task that it must show; None goes with any, and without a folder with the grasp.
        views: views that it must have.

    Raises:
        BadFile: no dataset there; the message says which command makes it.
        UnknownName: a view the dataset does not have.
        InputError: the dataset shows another task.
    """
    if folder is not None and not folder.exists():
        raise BadFile(
            f"There is no dataset {folder}; make it with "
            f"`surgicai-vision render-demos --out {folder}`, or give another folder."
        )
    task_shown = task or TaskConfig.task
    path = folder or dataset_folder(task_shown)
    if not path.exists():
        command = f"surgicai-vision render-demos --task {task_shown} --episodes 50"
        raise BadFile(
            f"There is no dataset {path}; make it with `{command}`, or give one with --dataset DIR."
        )
    from surgicai_vision.dataset.reader import open_dataset as open_folder

    dataset = open_folder(path)
    for view in views:
        check_name("view of this dataset", view, dataset.views)
    check_task(task, dataset.task, path)
    return dataset


def check_file(path: Path, name: str, suffixes: Sequence[str]) -> None:
    """Refuse an output file that cannot be written, and create its folder, before any work.

    Raises:
        InputError: the file cannot be written, or its suffix is not one of `suffixes`.
    """
    if path.suffix not in suffixes:
        raise InputError(f"{name} {path} ends in '{path.suffix}'; allowed: {', '.join(suffixes)}.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    except OSError as error:
        raise InputError(
            f"{name} {path} cannot be written: {error.strerror}; choose another place."
        ) from None
    os.close(descriptor)
    if not path.stat().st_size:
        path.unlink()
