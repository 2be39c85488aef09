"""Sandbox: reads untrusted recordings in a separate process with limits and without a network.

    arrays = read_sandboxed(Path("regrasp_all_episodes_merged.pkl"))
    arrays = read_sandboxed(Path("trial.bag"), "bag", topics={"psm2_pose": "/PSM2/measured_cp"})

The child first enters an empty network namespace, where the kernel allows it. Before it opens the
file, it limits its memory, its processor time and the size of what it writes. From then on, an
audit hook that cannot be removed ends the child at any attempt to start a process, open a socket or
write a file (its only output file is already open). It returns plain arrays (npz without pickles).
Any failure in it is raised as a `BadFile`, or as the `InputError` of its reader.
"""

import contextlib
import importlib
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import BadFile, InputError, SurgicaiError
from surgicai_vision.core.processes import ONE_THREAD, end_with_parent

READERS: Mapping[str, str] = MappingProxyType(
    {
        "surgicai": "surgicai_vision.demos.imports.surgicai_pickle",
        "bag": "surgicai_vision.demos.imports.rosbag.reader",
    }
)
"""Kind of file → the module whose `read(path, …)` returns its arrays."""

MEMORY = 2 * 2**30
"""Limit of the child's address space [byte]."""
PROCESSOR_SECONDS = 60
WALL_SECONDS = 120
MAX_WRITTEN = 2**30
"""Size limit of the child's only output file [byte]."""

REFUSED = (
    "socket.",
    "subprocess.",
    "os.system",
    "os.exec",
    "os.fork",
    "os.posix_spawn",
    "os.spawn",
    "ctypes.",
    "pty.",
    "os.chmod",
    "os.kill",
    "os.link",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.symlink",
    "os.truncate",
    "shutil.",
    "tempfile.",
)
"""Prefixes of the audit events that end the child."""


def read_sandboxed(
    path: Path, kind: str = "surgicai", **options: JSON
) -> dict[str, NDArray[np.generic]]:
    """Read a recording in a limited child process.

    Args:
        path: the file, or a bag's folder.
        kind: a key of `READERS`; see that module's `read` for what is returned.
        options: further arguments of that `read`.

    Raises:
        BadFile: a file that the reader refuses, or one that exceeds the limits.
        InputError: arguments that do not match the recording.
    """
    if not path.is_file() and not (path.is_dir() and kind == "bag"):
        raise BadFile(
            f"Cannot read {path}: {'it is a folder' if path.is_dir() else 'no such file'}."
        )
    with tempfile.TemporaryDirectory(prefix="surgicai-vision-") as folder:
        result = Path(folder) / "arrays.npz"
        try:
            child = subprocess.run(
                [
                    # Without -P, modules of the current folder would be imported and so run.
                    *(sys.executable, "-P", "-m", "surgicai_vision.demos.imports.sandbox"),
                    *(str(os.getpid()), str(path), str(result), kind, json.dumps(options)),
                ],
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": _search_path()},
                capture_output=True,
                text=True,
                stdin=subprocess.DEVNULL,
                timeout=WALL_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise BadFile(f"{path} was not read within {WALL_SECONDS} s.") from None
        if child.returncode == InputError.exit_code:
            error = json.loads(child.stderr.splitlines()[-1])
            raise (BadFile if error["is_bad_file"] else InputError)(error["message"])
        if child.returncode:
            raise BadFile(
                f"{path} could not be read within the limits ({MEMORY >> 30} GB of memory, "
                f"{PROCESSOR_SECONDS} s of processor time)."
            )
        with np.load(result, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}


def _search_path() -> str:
    """Return a PYTHONPATH with which the child finds the same package."""
    return str(Path(__file__).parents[3])


def _leave_network() -> None:
    """Move this process into an empty network namespace.

    Users other than root need a user namespace for this, which only a single-threaded process may
    create, so this runs before anything that starts another thread.
    """
    for namespaces in (os.CLONE_NEWNET, os.CLONE_NEWUSER | os.CLONE_NEWNET):
        with contextlib.suppress(OSError):  # not every kernel and container lets us
            os.unshare(namespaces)
            break


def _limit() -> None:
    """Drop the rights of this process that reading a file does not need."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_SECONDS, PROCESSOR_SECONDS))
    resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_WRITTEN, MAX_WRITTEN))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        flags = arguments[2] if event == "open" else None
        writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if writes or event.startswith(REFUSED):
            os._exit(1)

    sys.addaudithook(hook)


def main(path: str, result: str, kind: str, options: str) -> int:
    """Read `path` and write its arrays to `result`; this is the child's whole program."""
    read = importlib.import_module(READERS[kind]).read
    with open(result, "wb") as file:
        _limit()
        try:
            arrays = read(Path(path), **json.loads(options))
        except SurgicaiError as error:
            report = {"is_bad_file": isinstance(error, BadFile), "message": str(error)}
            print(json.dumps(report), file=sys.stderr)
            return InputError.exit_code
        np.savez(file, **arrays)
    return 0


if __name__ == "__main__":
    _leave_network()
    end_with_parent(int(sys.argv[1]))
    sys.exit(main(*sys.argv[2:]))
