"""Try a checkout where a first run may fail: odd paths, an unwritable home folder, no OpenGL.

    .venv/bin/python scripts/first_contact.py              # every situation this machine can create
    .venv/bin/python scripts/first_contact.py no-opengl    # only this one

Each situation runs a tiny quickstart in its own folder and checks the result. A situation that this
machine cannot create (another user without being root) is named and left out. The exit code is 1 if
one went wrong. CI runs it after the tests.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PYTHON = Path(sys.executable)
NOBODY = 65534
TINY = """\
task: grasp
demonstrations: 3
noise: 0.0
view: [back]
size: 32
policies:
  - {encoder: imagenet-lite-early, view: [back], change: [frame_stride=5, epochs=1]}
episodes: 1
workers: 2
"""
NO_OPENGL = "No image can be drawn"


@dataclass(frozen=True)
class Situation:
    """A situation in which the quickstart is tried.

    Attributes:
        folder: name of the folder it runs in.
        variables: changed environment variables; None removes a variable.
        command: prefix of the command: another user, or another view of the file system.
        home: mode of the home folder.
        refused: what it must say if it cannot work in the situation; "" if it must work.
        needs: returns why this machine cannot create the situation, or "".
    """

    folder: str = "work"
    variables: Mapping[str, str | None] = field(default_factory=dict)
    command: tuple[str, ...] = ()
    home: int = 0o755
    refused: str = ""
    needs: Callable[[], str] = lambda: ""


def needs_root() -> str:
    """Return why this process cannot act as another user, or ""."""
    if os.geteuid():
        return "needs root"
    if not shutil.which("setpriv"):
        return "needs setpriv (util-linux)"
    done = subprocess.run([*AS_NOBODY, str(PYTHON), "-c", ""], capture_output=True, check=False)
    return "" if done.returncode == 0 else f"a plain user cannot run {PYTHON}"


def needs_mounts() -> str:
    """Return why a home folder cannot be made read-only even for root, or ""."""
    if os.geteuid() or not shutil.which("unshare"):
        return "needs root and unshare (util-linux)"
    done = subprocess.run(["unshare", "-m", "true"], capture_output=True, check=False)
    return "" if done.returncode == 0 else "this container may not mount"


AS_NOBODY = ("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups")
READ_ONLY = (
    "unshare",
    "-m",
    "sh",
    "-c",
    'mount --bind "$HOME" "$HOME" && mount -o remount,bind,ro "$HOME" && exec "$@"',
    "sh",
)
SITUATIONS = {
    "plain": Situation(),
    "odd-path": Situation(folder="Übung mit Leerzeichen & 'Strich'"),
    "no-home": Situation(variables={"HOME": "/nonexistent"}),
    "home-read-only": Situation(command=READ_ONLY, needs=needs_mounts),
    "another-user": Situation(command=AS_NOBODY, needs=needs_root),
    "another-user-without-home": Situation(
        command=AS_NOBODY, variables={"HOME": "/root"}, needs=needs_root
    ),
    "c-locale": Situation(variables={"LC_ALL": "C", "LANG": None}),
    "no-opengl": Situation(
        variables={"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}, refused=NO_OPENGL
    ),
}


def attempt(situation: Situation, scratch: Path) -> str:
    """Run the quickstart in a situation; return what is wrong, or ""."""
    folder = scratch / situation.folder
    home = scratch / "home"
    for made in (folder, home):
        made.mkdir(parents=True)
        if os.geteuid() == 0:
            os.chown(made, NOBODY, NOBODY)
    home.chmod(situation.home)
    (folder / "tiny.yaml").write_text(TINY, encoding="utf-8")
    variables = {**os.environ, "HOME": str(home), **situation.variables}
    for name in ("SURGICAI_VISION_CACHE", "MUJOCO_GL", "XDG_CACHE_HOME", "MPLCONFIGDIR"):
        variables.pop(name, None)
    environment = {name: value for name, value in variables.items() if value is not None}
    words = ["-m", "surgicai_vision", "quickstart", "--config", "tiny.yaml", "--out", "schöne Naht"]
    done = subprocess.run(
        [*situation.command, str(PYTHON), *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    complaint = done.stderr.strip()
    last = complaint.splitlines()[-1] if complaint else ""
    if "Traceback" in complaint:
        return f"a traceback: {last}"
    if situation.refused:
        clear = done.returncode == 2 and situation.refused in last
        return (
            "" if clear else f"code {done.returncode}, expected 2 and '{situation.refused}': {last}"
        )
    if done.returncode:
        return f"code {done.returncode}: {last}"
    warned = [line for line in complaint.splitlines() if "arning" in line]
    if warned:
        return f"a warning: {warned[0]}"
    whole = all((folder / "schöne Naht" / name).is_file() for name in OUTPUTS)
    return "" if whole else f"{', '.join(OUTPUTS)} do not all exist"


OUTPUTS = ("report.html", "procedure/procedure.mp4", "procedure/strip.jpg")


def main(chosen: list[str]) -> int:
    """Try the situations, all of them by default; print one line per situation."""
    unknown = set(chosen) - set(SITUATIONS)
    if unknown:
        sys.exit(f"unknown: {', '.join(unknown)}; allowed: {', '.join(SITUATIONS)}")
    wrong = 0
    for name in chosen or SITUATIONS:
        situation = SITUATIONS[name]
        why_not = situation.needs()
        if why_not:
            print(f"skipped   {name}: {why_not}", flush=True)
            continue
        with tempfile.TemporaryDirectory(prefix="first-contact-") as scratch:
            Path(scratch).chmod(0o755)
            problem = attempt(situation, Path(scratch))
        wrong += bool(problem)
        print(
            f"{'WRONG   ' if problem else 'well    '}  {name}{problem and ': '}{problem}",
            flush=True,
        )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
