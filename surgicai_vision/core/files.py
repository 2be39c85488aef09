"""Files: written whole or not at all (temporary name, fsync, rename), hashed, and safe to read.

Every stage writes through this module, so a process killed at any moment leaves either the old
file, the new one, or a temporary name that the next run removes.
"""

import functools
import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

from surgicai_vision import __version__
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, SurgicaiError
from surgicai_vision.core.yaml_text import load_yaml

CACHE_VARIABLE = "SURGICAI_VISION_CACHE"
CACHE_HERE = Path("outputs") / "cache"
TEMPORARY = ".partial-"
"""Prefix of temporary names; files with it may be deleted while no process writes."""


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically."""
    temporary = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}-{path.name}")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def write_json(path: Path, value: object) -> None:
    """Write `value` as indented JSON, atomically."""
    write_bytes(path, (json.dumps(value, indent=2, sort_keys=True) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read JSON; raise `BadFile` if it is missing or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadFile(f"Cannot read {path}: {error.strerror}.") from None
    except ValueError as error:
        raise BadFile(f"{path} is not valid JSON ({error}).") from None
    except RecursionError:
        raise BadFile(f"{path} is refused: its JSON is nested too deeply.") from None


def read_yaml(path: Path, *, may_be_empty: bool = False) -> dict[str, object]:
    """Read a YAML file that holds a table.

    Args:
        path: the file.
        may_be_empty: a file that is empty, or has only comments, is an empty table.

    Raises:
        BadFile: the file is missing or damaged, or holds something else.
    """
    try:
        table = load_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadFile(f"Cannot read {path}: {error.strerror}.") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BadFile(f"{path} is not valid YAML ({' '.join(str(error).split())}).") from None
    except (RecursionError, ValueError) as error:
        problem = " ".join(str(error).split())[:100]
        raise BadFile(f"{path} is refused: {type(error).__name__} ({problem}).") from None
    if table is None and may_be_empty:
        return {}
    if not isinstance(table, dict) or not all(isinstance(key, str) for key in table):
        raise BadFile(f"{path} is not a table of keys; write one `key: value` per line.")
    return table


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`, whose file becomes `path` at the end.

    The folder is created if missing; an earlier file is replaced, but not on an error.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}-{path.name}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder next to `path`, renamed to it at the end; removed on an error.

    Raises:
        InputError: nothing can be renamed to `path` (`check_renamed`).
    """
    check_renamed(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}-{path.name}")
    temporary.mkdir()
    try:
        yield temporary
        sync_tree(temporary)
        os.rename(temporary, path)
        sync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def locked(
    path: Path, *, wait: bool = True, refusal: SurgicaiError | None = None
) -> Iterator[None]:
    """Hold the lock file `path`, which is removed at the end; a killed holder frees it.

    Args:
        path: the lock file; its folder exists.
        wait: wait for another holder.
        refusal: raised at once, instead of waiting, if another process holds it.

    Raises:
        filelock.Timeout: another process holds it, `wait` is false, and there is no `refusal`.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(FileLock(path, blocking=wait and refusal is None))
        except Timeout:
            if refusal is None:
                raise
            raise refusal from None
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def sync_tree(folder: Path) -> None:
    """Flush every file below `folder` to disk."""
    for root, _, files in os.walk(folder):
        for name in files:
            descriptor = os.open(os.path.join(root, name), os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        sync_folder(Path(root))


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_output(
    path: Path,
    *,
    may_resume: str | None = None,
    option: str = "--out",
    ours: Collection[str] = (),
) -> None:
    """Refuse an output folder that cannot be written or holds other files, before any work.

    Args:
        path: the folder to create.
        may_resume: name of the marker file of a folder that may be continued.
        option: the option that gave the folder, for the message.
        ours: names of other files that a killed run may leave without the marker; a folder with
            only these, and temporary files of these or of the marker, counts as empty.

    Raises:
        OutputExists: it holds other files, or is a file itself.
        InputError: it cannot be written, or its name is not allowed.
    """
    try:
        _check_output(path, may_resume, option, (*ours, *([may_resume] if may_resume else [])))
    except OSError as error:
        raise InputError(
            f"{option} {path} cannot be written: {error.strerror}; choose another folder."
        ) from None


def _check_output(path: Path, may_resume: str | None, option: str, ours: Collection[str]) -> None:
    """Do `check_output`; raise OSError if the system cannot check the path."""
    if path.exists():
        if not path.is_dir():
            raise OutputExists(f"{option} {path} is a file; give a folder that does not exist yet.")
        is_marked = may_resume is not None and (path / may_resume).exists()
        if not is_marked and any(not _is_left(file.name, ours) for file in path.iterdir()):
            raise OutputExists(
                f"{option} {path} already holds files; give a folder that does not exist yet."
            )
    parent = path
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise InputError(f"{option} {path} cannot be written: {parent} is a file.")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(
            f"{option} {path} cannot be written: no permission on {parent}; choose another folder."
        )


def check_renamed(path: Path, option: str = "--out") -> None:
    """Refuse an output folder that nothing can be renamed to, before any work.

    Args:
        path: the folder that another one becomes by one rename.
        option: the option that gave it, for the message.

    Raises:
        InputError: it is the current folder or one above it, a link, or a mount point.
    """
    if path.name in ("", "..") or path.is_symlink() or path.is_mount():
        raise InputError(
            f"{option} {path} is the current folder, a link or a mount point, which cannot be "
            "replaced by the finished folder; give a folder below it."
        )


def _is_left(name: str, ours: Collection[str]) -> bool:
    """Return True if a file is one of `ours`, or was to become one when a run was killed."""
    temporary = name.startswith(TEMPORARY) and name.endswith(tuple(f"-{one}" for one in ours))
    return name in ours or temporary


def remove_partial(folder: Path, ours: Collection[str]) -> None:
    """Remove temporary files that killed runs left in a folder, which no process still writes.

    Args:
        folder: the folder.
        ours: names of the files that they were to become.
    """
    for name in ours:
        for left in folder.glob(f"{TEMPORARY}*-{name}"):
            left.unlink(missing_ok=True)


def claim(path: Path, owner: Mapping[str, object], what: str) -> None:
    """Record in the file `path` what its folder belongs to; refuse a folder of something else.

    Args:
        path: a file in the folder, which is created.
        owner: everything that the folder's content depends on, as plain data.
        what: what the folder holds, for the message.

    Raises:
        OutputExists: the file exists and says something else.
    """
    if path.exists() and read_json(path) != owner:
        raise OutputExists(
            f"{path.parent} holds {what} of another policy, task or starts; give another --out."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, owner)


def sha256_file(path: Path) -> str:
    """Return the sha256 (hex) of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


PACKAGE = Path(__file__).parent.parent
"""The package `surgicai_vision`."""
FAMILIES = ("encoders", "policies")
"""Packages next to this one whose sources decide results."""
SHARED = tuple(
    PACKAGE / "core" / f"{name}.py"
    for name in (
        *("cameras", "config", "corruption", "generators", "names", "runs", "tasks"),
        *("shifts", "variants", "video"),
    )
)
"""Modules of `core` whose sources decide results, in every stage."""


@functools.cache
def code_version(*stages: str) -> str:
    """Return "<version>+<12 hex digits>": the sha256 over the sources of this package.

    Args:
        stages: only these stages ("envs", "demos", …) and the shared modules; none means all of
            them. The families "encoders" and "policies" are next to the package and count only if
            named.
    """
    package = PACKAGE
    digest = hashlib.sha256()
    for family in FAMILIES:
        for path in sorted((package.parent / family).rglob("*.py")) if family in stages else ():
            digest.update(f"{family}/{path.name}".encode() + b"\0" + path.read_bytes() + b"\0")
    for path in sorted(package.rglob("*.py")):
        stage = path.relative_to(package).parts[0]
        if not stages or stage in stages or path in SHARED:
            digest.update(
                str(path.relative_to(package)).encode() + b"\0" + path.read_bytes() + b"\0"
            )
    return f"{__version__}+{digest.hexdigest()[:12]}"


def cache_root() -> Path:
    """Return $SURGICAI_VISION_CACHE, or ~/.cache/surgicai-vision.

    If there is no home folder that can be written, as for some users of a container, it is
    `outputs/cache` in the current folder.
    """
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    try:
        home = Path.home()
    except RuntimeError:  # neither $HOME nor an entry for this user
        return CACHE_HERE
    at_home = home / ".cache" / "surgicai-vision"
    return at_home if home.is_dir() and is_writable(at_home) else CACHE_HERE


def is_writable(path: Path) -> bool:
    """Return True if `path`, or the first folder above it that exists, can be written."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path.is_dir() and os.access(path, os.W_OK | os.X_OK)


def configs_folder() -> Path:
    """Return the folder of the shipped configurations; in a checkout `configs/`."""
    shipped = PACKAGE / "configs"
    return shipped if shipped.is_dir() else PACKAGE.parent / "configs"
