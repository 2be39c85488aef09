"""The Ray engine: jobs as tasks of Ray Core, on this machine or on a cluster.

A cluster started here listens on loopback only, without a dashboard or usage reports. Ray restarts
a task whose worker or node was lost; its result is committed by one rename, so a task that ran
twice has one result. What is committed counts, whatever happens to Ray.
"""

import functools
import importlib.util
import logging
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, ClassVar, final

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.executor.engine import Ending, Engine, lost
from surgicai_vision.core.executor.jobs import Task, perform
from surgicai_vision.core.executor.local import VARIABLES
from surgicai_vision.core.processes import Failure, environment

if TYPE_CHECKING:
    from ray import ObjectRef

ATTEMPTS = 5
"""How often Ray starts a task whose worker or node is lost, unless the caller says."""

OBJECT_STORE = 80 * 2**20
"""Bytes of Ray's shared memory, its minimum: results are files, and nothing large is passed."""

CLUSTER_VARIABLES: Mapping[str, str] = {
    **VARIABLES,
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
}
"""Set while Ray starts, and so in its workers. The last one, read on Ray's import (ray 2.60,
_private/ray_constants.py), makes all its servers listen on 127.0.0.1 only; without it they
listen on all interfaces. A cluster of several nodes is started by its owner and given by its
address."""


@final
@dataclass(frozen=True)
class RayEngine(Engine):
    """Tasks of Ray Core.

    Attributes:
        address: of a running cluster whose nodes see the store under the same path, as HOST:PORT;
            None starts Ray on this machine only.
    """

    name: ClassVar[str] = "ray"
    address: str | None = None

    def __post_init__(self) -> None:
        if importlib.util.find_spec("ray") is None:
            raise InputError(
                "--executor ray needs Ray, which is not installed: "
                "`pip install 'surgicai-vision[ray]'`, or leave it out."
            )

    def execute(
        self, tasks: Mapping[str, Task], workers: int, attempts: int | None = None
    ) -> Generator[Ending]:
        """Do the tasks, `workers` at a time."""
        if not tasks:
            return
        times = attempts or ATTEMPTS
        most = max(1, workers)
        with _cluster(most, self.address) as ray:
            remote = ray.remote(num_cpus=1, max_retries=times - 1)(_perform)
            queue = list(tasks)
            running: dict[ObjectRef[Failure | None], str] = {}
            while queue or running:
                while queue and len(running) < most:
                    key = queue.pop(0)
                    task = tasks[key]
                    arguments = dict(task.job.arguments)
                    reference = remote.remote(task.function, arguments, str(task.destination))
                    running[reference] = key
                ready, _ = ray.wait(list(running), num_returns=1)
                for reference in ready:
                    key = running.pop(reference)
                    yield key, _error(ray, reference, tasks[key], times)


def _perform(function: str, arguments: dict[str, JSON], destination: str) -> Failure | None:
    """Do one job in a worker of Ray; a cluster of several nodes has its own environment."""
    with environment(VARIABLES):
        return perform(function, arguments, destination)


def _error(
    ray: ModuleType, reference: "ObjectRef[Failure | None]", task: Task, times: int
) -> SurgicaiError | None:
    """Return the error that a task ended in; None if its result is committed."""
    try:
        failure: Failure | None = ray.get(reference)
    except ray.exceptions.RayError as error:
        return lost(task.job, times, f"{type(error).__name__}: killed, or out of memory")
    return failure.as_error(str(task.job)) if failure else None


@contextmanager
def _cluster(workers: int, address: str | None) -> Iterator[ModuleType]:
    """Connect to the cluster at `address`, or start one; leave it at the end."""
    try:
        with nullcontext() if address else environment(CLUSTER_VARIABLES):
            import ray

            if ray.is_initialized():
                raise InputError(
                    "This process is connected to Ray already; leave it first (ray.shutdown())."
                )
            quiet = functools.partial(ray.init, log_to_driver=False, logging_level=logging.ERROR)
            if address:
                quiet(address=address)
            else:
                quiet(
                    address="local",
                    num_cpus=workers,
                    include_dashboard=False,
                    object_store_memory=OBJECT_STORE,
                )
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        text = (str(error).splitlines() or [type(error).__name__])[0]
        where = address or "this machine"
        raise InputError(f"Ray cannot be reached at {where}: {text}") from None
    try:
        if not address and ray.util.get_node_ip_address() != "127.0.0.1":
            raise SurgicaiError(
                "Ray listens beyond loopback, because it was imported earlier; "
                "give its address as an option of the executor."
            )
        yield ray
    finally:
        ray.shutdown()
