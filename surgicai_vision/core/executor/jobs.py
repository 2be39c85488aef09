"""Jobs: registered functions with JSON arguments, what their results are stored under, and how one
is done.
"""

import functools
import importlib
import importlib.metadata
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from surgicai_vision.core.config import digest
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.files import code_version, whole_folder


@dataclass(frozen=True)
class JobKind:
    """What a job's name stands for.

    Attributes:
        function: "module:function", imported in the worker on first use.
        stages: the stages whose sources decide the result; a change in them makes a new key.
        packages: distributions whose versions decide it too.
    """

    function: str
    stages: tuple[str, ...] = ()
    packages: tuple[str, ...] = ("mujoco", "numpy")


_DATA = ("scene", "envs", "demos", "dataset")
_LEARN = (*_DATA, "features", "training", "experiments", "encoders", "policies")
_CELL = (*_LEARN, "evaluation")
_NUMERIC = ("mujoco", "numpy", "torch", "timm", "lerobot")

JOBS: Mapping[str, JobKind] = MappingProxyType(
    {
        "record-episode": JobKind(
            "surgicai_vision.demos.record:record_episode", ("scene", "envs", "demos")
        ),
        "drive-episode": JobKind(
            "surgicai_vision.experiments.dagger:record_driven", _CELL, _NUMERIC
        ),
        "render-episode": JobKind(
            "surgicai_vision.dataset.render:render_episode", ("scene", "envs", "demos", "dataset")
        ),
        "encode-video": JobKind(
            "surgicai_vision.dataset.video_jobs:encode_block", ("dataset",), ("numpy", "av")
        ),
        "sweep-features": JobKind(
            "surgicai_vision.experiments.sweep.jobs:encode_features", _LEARN, _NUMERIC
        ),
        "sweep-policy": JobKind(
            "surgicai_vision.experiments.sweep.jobs:train_policy", _LEARN, _NUMERIC
        ),
        "sweep-cell": JobKind("surgicai_vision.experiments.sweep.jobs:run_cell", _CELL, _NUMERIC),
        "sweep-probe": JobKind(
            "surgicai_vision.experiments.sweep.jobs:run_probe", _LEARN, _NUMERIC
        ),
        "sweep-reference": JobKind(
            "surgicai_vision.experiments.sweep.jobs:run_reference", _CELL, _NUMERIC
        ),
    }
)

WORKER_ENVIRONMENT: Mapping[str, str] = MappingProxyType(
    {
        "LP_NUM_THREADS": "0",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "HF_HUB_OFFLINE": "1",
    }
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
        label: arguments named here are left out of the key (where a file lies does not change what
            it holds).
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
                "packages": [_version(name) for name in table[self.name].packages],
            }
        )


@functools.cache
def _version(package: str) -> str:
    return f"{package} {importlib.metadata.version(package)}"


def work(
    function: str, arguments: dict[str, Any], destination: Path
) -> tuple[int, str, str] | None:
    """Do one job; return None, or (exit code, message, traceback) since not every exception can be
    pickled.
    """
    if destination.is_dir():  # its worker was killed after the commit and before it could say so
        return None
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


def failure_of(failure: tuple[int, str, str] | None, job: Job) -> SurgicaiError | None:
    """Return what a job reported as the error it stands for, its traceback in a note; None for a
    job done.
    """
    if failure is None:
        return None
    code, message, trace = failure
    if not trace:
        return (InputError if code == InputError.exit_code else SurgicaiError)(message)
    error = SurgicaiError(f"{describe(job)} failed: {message}")
    error.add_note(trace)
    return error


def describe(job: Job) -> str:
    """Return a job in a few words for a message."""
    text = ", ".join(
        f"{key}={value}" for key, value in job.arguments.items() if isinstance(value, (str, int))
    )
    return f"{job.name}({text})"
