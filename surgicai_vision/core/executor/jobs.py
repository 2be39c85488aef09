"""Jobs: registered functions with JSON arguments, and what their results are stored under.

The module that defines a job's function registers it; a worker imports that module by the
function's own path:

    @job("record-episode", stages=("scene", "envs", "demos"))
    def record_episode(folder: Path, *, seed: int) -> None: …
"""

import functools
import importlib
import importlib.metadata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

from surgicai_vision.core.config import JSON, digest
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.core.files import code_version, whole_folder
from surgicai_vision.core.processes import Failure

F = TypeVar("F", bound=Callable[..., None])


@dataclass(frozen=True)
class JobKind:
    """What a job's name refers to.

    Attributes:
        function: "module:function", imported in the worker on first use.
        stages: the stages whose sources decide the result; a change in them makes a new key.
        packages: distributions whose versions decide it too.
    """

    function: str
    stages: tuple[str, ...]
    packages: tuple[str, ...]


_kinds: dict[str, JobKind] = {}

JOBS: Mapping[str, JobKind] = MappingProxyType(_kinds)
"""Name → what it refers to, for the jobs of modules imported so far."""


def register_job(
    name: str,
    function: str,
    *,
    stages: tuple[str, ...],
    packages: tuple[str, ...] = ("mujoco", "numpy"),
) -> None:
    """Register a job whose function is not imported yet.

    Args:
        name: name of the jobs of this kind, which must be unique.
        function: "module:function", called as `function(folder, **arguments)`.
        stages: the packages of surgicai_vision whose sources decide the result, or a family next
            to it ("encoders", "policies"); the modules `core.files.SHARED` always count.
        packages: distributions whose versions decide the result.

    Raises:
        InputError: the name already refers to another function.
    """
    kind = JobKind(function, stages, packages)
    known = _kinds.setdefault(name, kind)
    if known.function != function:
        raise InputError(f"Job '{name}' is {known.function} already; give {function} another name.")
    _kinds[name] = kind


def job(
    name: str,
    *,
    stages: tuple[str, ...],
    packages: tuple[str, ...] = ("mujoco", "numpy"),
) -> Callable[[F], F]:
    """Register the decorated function as a job; the arguments are those of `register_job`."""

    def register(function: F) -> F:
        path = f"{function.__module__}:{function.__qualname__}"
        register_job(name, path, stages=stages, packages=packages)
        return function

    return register


@dataclass(frozen=True)
class Job:
    """One unit of work.

    Attributes:
        name: a registered name.
        arguments: JSON data, the function's keyword arguments.
        inputs: hashes of what the job reads besides its arguments.
        weight: its weight in the progress.
        label: names of arguments that are left out of the key, such as the path of a file, which
            does not change its content.
    """

    name: str
    arguments: Mapping[str, JSON]
    inputs: tuple[str, ...] = ()
    weight: int = 1
    label: tuple[str, ...] = ()

    @property
    def kind(self) -> JobKind:
        """Return what the name refers to.

        Raises:
            UnknownName: no imported module registers it.
        """
        return _kinds[check_name("job", self.name, _kinds)]

    def key(self) -> str:
        """Return the sha256 (hex) under which the result is stored."""
        counted = {name: value for name, value in self.arguments.items() if name not in self.label}
        return digest(
            {
                "name": self.name,
                "arguments": counted,
                "inputs": list(self.inputs),
                "code": code_version(*self.kind.stages),
                "packages": [_version(name) for name in self.kind.packages],
            }
        )

    def __str__(self) -> str:
        """Return the job in a few words for a message."""
        shown = (
            f"{name}={value}"
            for name, value in self.arguments.items()
            if isinstance(value, (str, int))
        )
        return f"{self.name}({', '.join(shown)})"


@functools.cache
def _version(package: str) -> str:
    return f"{package} {importlib.metadata.version(package)}"


@dataclass(frozen=True)
class Task:
    """A job to do, as an engine receives it.

    Attributes:
        job: the job, for messages.
        function: "module:function".
        destination: the folder that holds the result once it is committed.
    """

    job: Job
    function: str
    destination: Path

    def do(self) -> Failure | None:
        """Do the job in this process; return its failure, if any."""
        return perform(self.function, dict(self.job.arguments), str(self.destination))


def perform(function: str, arguments: dict[str, JSON], destination: str) -> Failure | None:
    """Do one job and commit its result; every engine runs this function in its workers."""
    target = Path(destination)
    if target.is_dir():  # its worker was killed after the commit, before it could report it
        return None
    try:
        module, _, name = function.partition(":")
        with whole_folder(target) as folder:
            getattr(importlib.import_module(module), name)(folder, **arguments)
    except Exception as error:
        if target.is_dir():  # another process committed the same result first
            return None
        return Failure.of(error)
    return None
