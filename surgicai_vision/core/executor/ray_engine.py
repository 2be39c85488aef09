"""The Ray engine: the same jobs as tasks of Ray Core, on this machine or on a cluster.

A cluster of its own listens on loopback only, without a dashboard and without reports of use. Ray
starts a task again whose worker or node was lost; its result is committed by one rename, so that a
task done twice is there once. What is committed counts, whatever becomes of Ray.
"""

import importlib.util
import logging
import os
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.executor.jobs import (
    WORKER_ENVIRONMENT,
    Job,
    JobKind,
    describe,
    failure_of,
    work,
)

ATTEMPTS = 5
"""How often Ray starts a task whose worker or node is lost, where the caller does not say."""

OBJECT_STORE = 80 * 2**20
"""Bytes of Ray's shared memory, its least: results are files, and nothing of size is passed through
it.
"""

ENVIRONMENT: Mapping[str, str] = {
    **WORKER_ENVIRONMENT,
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
}
"""Set while Ray starts, and so in its workers. The last one, read on Ray's import (ray 2.60,
_private/ray_constants.py), makes every one of its servers listen on 127.0.0.1 alone; without it
they listen on all interfaces. A cluster of several nodes is started by its owner and given by
address."""


def check() -> None:
    """Raise `InputError` where Ray is not installed."""
    if importlib.util.find_spec("ray") is None:
        raise InputError(
            "--executor ray needs Ray, which is not installed: `pip install 'surgicai-vision[ray]'`, or leave it out."
        )


def execute(
    jobs: Mapping[str, Job],
    store: Path,
    workers: int,
    table: Mapping[str, JobKind],
    address: str | None,
    attempts: int | None = None,
) -> Generator[tuple[str, SurgicaiError | None]]:
    """Do `jobs` as Ray tasks, `workers` at a time; yield each key as it is committed, or with the
    job's error.
    """
    if not jobs:
        return
    with _cluster(max(1, workers), address) as ray:
        task = ray.remote(num_cpus=1, max_retries=(attempts or ATTEMPTS) - 1)(_task)
        queue = list(jobs)
        running: dict[Any, str] = {}
        while queue or running:
            while queue and len(running) < max(1, workers):
                key = queue.pop(0)
                job = jobs[key]
                running[
                    task.remote(table[job.name].function, dict(job.arguments), str(store / key))
                ] = key
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                key = running.pop(reference)
                yield key, _error(ray, reference, jobs[key], attempts or ATTEMPTS)


def _error(ray: Any, reference: Any, job: Job, attempts: int) -> SurgicaiError | None:
    """Return what a task ended in: None where its result is committed."""
    try:
        return failure_of(ray.get(reference), job)
    except ray.exceptions.RayError as error:
        return SurgicaiError(
            f"Ray lost {describe(job)} {attempts} times ({type(error).__name__}: a worker was killed, or out of "
            "memory). What is finished is kept: run the same command again, with fewer workers."
        )


def _task(function: str, arguments: dict[str, Any], destination: str) -> Any:
    """Do one job in a worker of Ray."""
    os.environ.update(WORKER_ENVIRONMENT)
    return work(function, arguments, Path(destination))


@contextmanager
def _cluster(workers: int, address: str | None) -> Iterator[Any]:
    """Connect to the cluster at `address`, or start one; leave it at the end."""
    before = {name: os.environ.get(name) for name in ENVIRONMENT}
    own: dict[str, Any] = {
        "num_cpus": workers,
        "include_dashboard": False,
        "object_store_memory": OBJECT_STORE,
    }
    if not address:
        os.environ.update(ENVIRONMENT)
    try:
        import ray

        if ray.is_initialized():
            raise InputError(
                "This process is connected to Ray already; leave it first (ray.shutdown())."
            )
        ray.init(
            address=address or "local",
            log_to_driver=False,
            logging_level=logging.ERROR,
            **({} if address else own),
        )
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        text = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"Ray cannot be reached at {address or 'this machine'}: {text}") from None
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
    try:
        if not address and ray.util.get_node_ip_address() != "127.0.0.1":
            raise SurgicaiError(
                "Ray listens beyond loopback, since it was imported before; start it by --address."
            )
        yield ray
    finally:
        ray.shutdown()
