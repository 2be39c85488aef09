"""Render on a Ray cluster of two nodes while its workers are killed and a node is lost.

Compare with an undisturbed run.

    python benchmarks/cluster.py --kills 10 --losses 1 --json

Both nodes run on this machine's loopback and share its disk. The kills are spread over the
episodes; a lost node is replaced. Prints one JSON object last: whether the dataset is identical
(digest and file fingerprint) and how many episodes it has twice. Exits with 1 unless it is
identical, has no episode twice, and all kills and losses happened.
"""

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from kill import RENDER, committed, finish, make_demos, start

LOOPBACK = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""As in `surgicai_vision.core.executor.ray`; read when Ray is imported."""


class TwoNodes:
    """A local Ray cluster of a head and another node, with one worker each."""

    def __init__(self, cluster):
        self._cluster = cluster
        self.address = cluster.address
        self._node = cluster.add_node(**_node())

    def lose_node(self) -> bool:
        """Kill the second node with all its processes and replace it."""
        self._cluster.remove_node(self._node, allow_graceful=False)
        self._node = self._cluster.add_node(**_node())
        return True

    def kill_worker(self, moments: random.Random) -> bool:
        """Kill one worker that has a task; return whether there was one."""
        return kill_one(busy_workers(), moments)


def _node() -> dict:
    return {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}


@contextmanager
def two_nodes() -> Iterator[TwoNodes]:
    """Start the cluster; stop it at the end."""
    os.environ.update(LOOPBACK)
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args=_node())
    try:
        yield TwoNodes(cluster)
    finally:
        cluster.shutdown()


def busy_workers() -> list[int]:
    """Return the processes in which Ray is running a task of the executor.

    Ray names them after the task.
    """
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.read_bytes().startswith(b"ray::_task"):
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


def children(parent: int, name: bytes = b"spawn_main") -> list[int]:
    """Return the child processes of `parent` with `name` in their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
            if int(fields[1]) == parent and name in (path.parent / "cmdline").read_bytes():
                found.append(int(path.parent.name))
        except (OSError, IndexError):
            continue
    return found


def kill_one(workers: list[int], moments: random.Random) -> bool:
    """Kill one of some processes; return whether there was one."""
    if not workers:
        return False
    try:
        os.kill(moments.choice(sorted(workers)), signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def spread(
    events: list[Callable[[], bool]], total: int, moments: random.Random
) -> list[tuple[int, Callable]]:
    """Return each event with the number of finished jobs at which it is due, in order."""
    due = sorted(moments.sample(range(total), min(total, len(events))))
    return list(zip(due, moments.sample(events, len(events)), strict=False))


def main() -> int:
    """Run the undisturbed and the disturbed rendering; exit 1 unless the datasets are identical."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--losses", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--json", action="store_true", help="accepted for symmetry; the last line is always JSON"
    )
    arguments = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    root = Path(tempfile.mkdtemp(prefix="surgicai-vision-cluster-"))
    script = root / "render.py"
    script.write_text(RENDER)
    make_demos(root / "demos", arguments.episodes)
    began = time.monotonic()
    reference = finish(start(script, root / "demos", root / "reference", 2))
    quiet = time.monotonic() - began
    moments = random.Random(arguments.seed)
    said = {"kills": 0, "losses": 0}
    with two_nodes() as cluster:

        def lose() -> bool:
            said["losses"] += 1
            return cluster.lose_node()

        def kill() -> bool:
            done = cluster.kill_worker(moments)
            said["kills"] += done
            return done

        events = spread(
            [kill] * arguments.kills + [lose] * arguments.losses, arguments.episodes - 1, moments
        )
        began = time.monotonic()
        process = start(script, root / "demos", root / "disturbed", 2, cluster.address)
        while process.poll() is None:
            if events and committed(root / "disturbed") >= events[0][0] and events[0][1]():
                events.pop(0)
            time.sleep(0.02)
        result = finish(process)
        disturbed = time.monotonic() - began
    row = {
        "episodes": arguments.episodes,
        "frames": result[2],
        **said,
        "identical": result == reference,
        "duplicates": result[3] - arguments.episodes,
        "seconds": {"quiet": round(quiet, 1), "disturbed": round(disturbed, 1)},
    }
    shutil.rmtree(root)
    print(json.dumps(row))
    return int(not row["identical"] or row["duplicates"] != 0 or bool(events))


if __name__ == "__main__":
    sys.exit(main())
