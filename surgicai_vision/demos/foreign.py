"""Read foreign recordings at arm's length: in a process of its own, with limits, without a network.

    arrays = read_foreign(Path("regrasp_all_episodes_merged.pkl"))

The child sets its limits before it opens the file: memory, processor time, size of what it writes; an audit
hook that cannot be removed then ends every attempt to start a process, to open a socket or to write anything
but its one result. It hands back plain arrays (npz without pickles). Whatever goes wrong in it is a `BadFile`.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from surgicai_vision.errors import BadFile, SurgicaiError

MEMORY, PROCESSOR_SECONDS, WALL_SECONDS, WRITTEN = 2 * 2**30, 60, 120, 2**30
"""Limits of the child: bytes of address space, seconds, bytes of one file."""

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
)
"""Audit events (by their beginning) that end the child."""


def read_foreign(path: Path) -> dict[str, np.ndarray]:
    """Read a recording of SurgicAI in a limited child process; see `surgicai.read` for what comes back.

    Raises:
        BadFile: what `surgicai.read` refuses, and what exceeds the limits.
    """
    if not path.is_file():
        raise BadFile(f"Cannot read {path}: {'it is a folder' if path.is_dir() else 'no such file'}.")
    with tempfile.TemporaryDirectory(prefix="surgicai-vision-") as folder:
        result = Path(folder) / "arrays.npz"
        command = [sys.executable, "-m", "surgicai_vision.demos.foreign", str(path), str(result)]
        try:
            child = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=WALL_SECONDS,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": _search_path()},
            )
        except subprocess.TimeoutExpired:
            raise BadFile(f"{path} was not read within {WALL_SECONDS} s.") from None
        if child.returncode == BadFile.exit_code:
            raise BadFile(json.loads(child.stderr.splitlines()[-1]))
        if child.returncode:
            raise BadFile(
                f"{path} could not be read within the limits ({MEMORY >> 30} GB of memory, "
                f"{PROCESSOR_SECONDS} s of processor time)."
            )
        with np.load(result, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}


def _search_path() -> str:
    """Return a PYTHONPATH by which the child finds the same package."""
    return str(Path(__file__).parents[2])


def _limit(result: Path) -> None:
    """Take from this process what reading a file does not need."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_SECONDS, PROCESSOR_SECONDS))
    resource.setrlimit(resource.RLIMIT_FSIZE, (WRITTEN, WRITTEN))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event.startswith(REFUSED):
            os._exit(1)
        if event == "open":
            name, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if writes and os.fspath(name) != os.fspath(result):
                os._exit(1)

    sys.addaudithook(hook)


def main(path: str, result: str) -> int:
    """Read `path`, write its arrays to `result`; the child's whole program."""
    from surgicai_vision.demos import surgicai

    _limit(Path(result))
    try:
        arrays = surgicai.read(Path(path))
    except SurgicaiError as error:
        print(json.dumps(str(error)), file=sys.stderr)
        return BadFile.exit_code
    np.savez(result, **arrays)  # type: ignore[arg-type]
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
