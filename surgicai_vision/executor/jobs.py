"""Jobs: registered functions with JSON arguments, what their results are stored under, and how one is done."""

import functools
import importlib
import importlib.metadata
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from surgicai_vision.config import digest
from surgicai_vision.errors import InputError, SurgicaiError
from surgicai_vision.files import code_version, whole_folder


@dataclass(frozen=True)
class JobKind:
    """What a job's name stands for.

    Attributes:
        function: "module:function", imported in the worker on first use.
        stages: the stages whose sources decide the result; a change in them makes a new key.
    """

    function: str
    stages: tuple[str, ...] = ()


JOBS: Mapping[str, JobKind] = MappingProxyType(
    {
        "record-episode": JobKind("surgicai_vision.demos.record:record_episode", ("scene", "envs", "demos")),
        "render-episode": JobKind(
            "surgicai_vision.dataset.rendering:render_episode", ("scene", "envs", "demos", "dataset")
        ),
    }
)

WORKER_ENVIRONMENT: Mapping[str, str] = MappingProxyType(
    {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
)
"""One worker, one core: llvmpipe's and the BLAS's own threads would fight over it (measured: two
single-threaded processes scale linearly)."""


@dataclass(frozen=True)
class Job:
    """One unit of work.

    Attributes:
        name: a key of the table of jobs.
        arguments: JSON data, the function's keyword arguments.
        inputs: hashes of what the job reads besides its arguments.
        weight: what it counts for in the progress.
        label: arguments named here are left out of the key (where a file lies does not change what it holds).
    """

    name: str
    arguments: Mapping[str, Any]
    inputs: tuple[str, ...] = ()
    weight: int = 1
    label: tuple[str, ...] = ()

    def key(self, table: Mapping[str, JobKind] = JOBS) -> str:
        """Return the sha256 (hex) under which the result is stored."""
        return digest(
            {
                "name": self.name,
                "arguments": {k: v for k, v in self.arguments.items() if k not in self.label},
                "inputs": list(self.inputs),
                "code": code_version(*table[self.name].stages),
                "packages": _package_versions(),
            }
        )


@functools.cache
def _package_versions() -> list[str]:
    """Return the versions of the packages that decide numbers and pictures."""
    return [f"{name} {importlib.metadata.version(name)}" for name in ("mujoco", "numpy")]


def work(function: str, arguments: dict[str, Any], destination: Path) -> tuple[int, str, str] | None:
    """Do one job; return None, or (exit code, message, traceback) since not every exception can be pickled."""
    try:
        module, _, name = function.partition(":")
        with whole_folder(destination) as folder:
            getattr(importlib.import_module(module), name)(folder, **arguments)
    except SurgicaiError as error:
        return error.exit_code, str(error), ""
    except Exception as error:
        if destination.is_dir():  # somebody else committed the same result first
            return None
        return 1, f"{type(error).__name__}: {error}", traceback.format_exc()
    return None


def raise_failure(failure: tuple[int, str, str] | None, job: Job) -> None:
    """Raise what a job reported."""
    if failure is None:
        return
    code, message, trace = failure
    if not trace:
        raise (InputError if code == InputError.exit_code else SurgicaiError)(message)
    error = SurgicaiError(f"{describe(job)} failed: {message}")
    error.add_note(trace)
    raise error


def describe(job: Job) -> str:
    """Return a job in a few words for a message."""
    text = ", ".join(f"{key}={value}" for key, value in job.arguments.items() if isinstance(value, (str, int)))
    return f"{job.name}({text})"
