"""Options: a frozen dataclass per verb becomes its command line and the schema of its `--config`
file.

Values are taken in this order: the command line, the file, the dataclass's default.
"""

import argparse
import dataclasses
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, UnknownName, check_name

T = TypeVar("T")
Check = Callable[[str, Any], None]


def option(
    default: Any,
    text: str,
    *,
    check: Check | None = None,
    metavar: str = "",
    default_text: str = "",
    repeat: bool = False,
) -> Any:
    """Declare an option.

    Args:
        default: its default; `dataclasses.MISSING` makes it a required positional argument.
        text: what it is, for `--help`.
        check: called with the option's name and value; raises `InputError`.
        metavar: how `--help` names its value.
        default_text: what `--help` says of a default that depends on other options.
        repeat: it may be given again: texts are joined by commas, lists one behind the other.
    """
    metadata = {
        "text": text,
        "check": check,
        "metavar": metavar,
        "default_text": default_text,
        "repeat": repeat,
    }
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def task_config(task: str, env: dict[str, Any] | None) -> TaskConfig:
    """Return the configuration of `task`, changed by the table `env` of a `--config` file.

    Raises:
        UnknownName: a key that `TaskConfig` does not have.
        InputError: a value that is not allowed, or the task itself, which is an option of its own.
    """
    changes = env or {}
    if "task" in changes:
        raise InputError("env: the task is an option of its own; write `task:` beside `env:`.")
    return from_mapping(TaskConfig, {**changes, "task": task}, "env")


def config_only() -> Any:
    """Declare a table that only the `--config` file can give."""
    return dataclasses.field(default=None, metadata={"config_only": True})


def positive(name: str, value: float | None) -> None:
    """Refuse a number below 1."""
    if value is not None and value < 1:
        raise InputError(f"{name} is {value}; it must be at least 1.")


def image_size(name: str, value: int) -> None:
    """Refuse a size that the renderer has no room for [px]."""
    if not 16 <= value <= 960:
        raise InputError(f"{name} is {value}; it must be within 16 and 960 pixels.")


def not_negative(name: str, value: float | None) -> None:
    """Refuse a number below 0."""
    if value is not None and value < 0:
        raise InputError(f"{name} is {value}; it must be at least 0.")


def share(name: str, value: float | None) -> None:
    """Refuse a number that is not within 0 and 1."""
    if value is not None and not 0 <= value <= 1:
        raise InputError(f"{name} is {value}; it must be within 0 and 1.")


def one_of(kind: str, allowed: Iterable[str]) -> Check:
    """Return a check that admits one of `allowed`."""
    known = tuple(allowed)

    def check(_: str, value: str | None) -> None:
        if value is not None:
            check_name(kind, value, known)

    return check


def many_of(kind: str, allowed: Iterable[str]) -> Check:
    """Return a check that admits a list without repetition of names among `allowed`."""
    known = tuple(allowed)

    def check(name: str, values: tuple[str, ...] | None) -> None:
        for value in values or ():
            check_name(kind, value, known)
            if values and values.count(value) > 1:
                raise InputError(f"{name} names '{value}' twice; give each {kind} once.")

    return check


def add_arguments(parser: argparse.ArgumentParser, cls: type) -> None:
    """Add the options of the dataclass `cls` to `parser`; what is not given stays out of the
    result.
    """
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        meta = field.metadata
        if meta.get("config_only"):
            continue
        hint = _plain(hints[field.name])
        keywords: dict[str, Any] = {"default": argparse.SUPPRESS, "help": _help(field)}
        if hint is bool:
            keywords["action"] = argparse.BooleanOptionalAction
        else:
            keywords["type"] = _READERS.get(hint, _names)
            keywords["action"] = _Joined if meta.get("repeat") else "store"
            keywords["metavar"] = meta["metavar"] or field.name.upper()
        if field.default is dataclasses.MISSING:
            parser.add_argument(field.name, **keywords)
        else:
            parser.add_argument(flag(field.name), dest=field.name, **keywords)


def executor_option() -> Any:
    """Declare `executor`: what runs a verb's jobs; `executor.open_engine` reads it."""
    return option(
        "local",
        "what runs the jobs: local, ray or slurm, with its options, such as ray,address=HOST:PORT or "
        "slurm,partition=cpu,minutes=60",
        metavar="NAME[,KEY=VALUE]",
    )


def weights_option() -> Any:
    """Declare `weights`: the files of pretrained weights; `encoders.weights_of` reads it."""
    return option(
        None,
        "file with the encoder's pretrained weights; NAME=FILE for the encoder NAME alone, once for each encoder",
        metavar="[NAME=]FILE",
        repeat=True,
    )


def flag(name: str) -> str:
    """The command-line spelling of a field's name; `from_` is `--from`, a keyword of Python."""
    return f"--{name.rstrip('_').replace('_', '-')}"


def build(cls: type[T], given: Mapping[str, Any], config: Path | None) -> T:
    """Build the options from the command line's values and a YAML file, and check every value.

    Raises:
        BadFile: a file that is missing or no YAML table.
        UnknownName: a key of the file that the verb does not have.
        InputError: a value out of its range.
    """
    values = _read(cls, config) if config else {}
    options = from_mapping(cls, {**values, **given}, where=str(config) if config else "options")
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        check = field.metadata.get("check")
        if check is not None:
            check(flag(field.name), getattr(options, field.name))
    return options


def _read(cls: type, path: Path) -> dict[str, Any]:
    """Read a YAML table; a comma list is taken where a list is wanted."""
    table = read_yaml(path)
    hints = typing.get_type_hints(cls)
    for key, value in table.items():
        if key in hints and typing.get_origin(hints[key]) is tuple and isinstance(value, str):
            try:
                table[key] = list(_READERS.get(hints[key], _names)(value))
            except argparse.ArgumentTypeError as error:
                raise InputError(f"{path}: {key}: {error}.") from None
    return table


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds a table; `BadFile` where it is missing or something else."""
    import yaml

    try:
        table = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadFile(f"Cannot read {path}: {error.strerror}.") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BadFile(f"{path} is not valid YAML ({' '.join(str(error).split())}).") from None
    except (RecursionError, ValueError) as error:
        raise BadFile(
            f"{path} is not taken: {type(error).__name__} ({' '.join(str(error).split())[:100]})."
        ) from None
    if not isinstance(table, dict) or not all(isinstance(key, str) for key in table):
        raise BadFile(f"{path} holds no table of keys; write one `key: value` a line.")
    return table


def nearest_option(given: str, parser: argparse.ArgumentParser) -> UnknownName:
    """Return the error for an option that `parser` does not have."""
    return UnknownName("option", given.split("=")[0], parser._option_string_actions)


class _Joined(argparse.Action):
    """An option that may be given again."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None
    ) -> None:
        """Join texts by commas, lists one behind the other."""
        before = getattr(namespace, self.dest, None)
        joined = f"{before},{values}" if isinstance(values, str) else (*(before or ()), *values)
        setattr(namespace, self.dest, values if before is None else joined)


def _help(field: "dataclasses.Field[Any]") -> str:
    """An option's help with its default."""
    text = field.metadata["text"]
    shown = field.metadata["default_text"]
    if not shown and field.default is not dataclasses.MISSING and field.default is not None:
        default = field.default
        shown = ",".join(map(_shown, default)) if isinstance(default, tuple) else str(default)
        shown = {"True": "on", "False": "off"}.get(shown, shown)
    return (f"{text} (default: {shown})" if shown else text).replace("%", "%%")


def _shown(item: Any) -> str:
    return f"{item:g}" if isinstance(item, float) else str(item)


def _plain(hint: Any) -> Any:
    """The type behind `X | None`."""
    if isinstance(hint, types.UnionType):
        return next(part for part in typing.get_args(hint) if part is not type(None))
    return hint


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got '{text}'") from None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number, got '{text}'") from None


def _names(text: str) -> tuple[str, ...]:
    """Read a comma list; the empty text is the empty list."""
    parts = tuple(part.strip() for part in text.split(","))
    if parts == ("",):
        return ()
    if "" in parts:
        raise argparse.ArgumentTypeError(f"expected names between commas, got '{text}'")
    return parts


def _numbers(text: str) -> tuple[float, ...]:
    """Read a comma list of numbers."""
    return tuple(map(_number, _names(text)))


_READERS: Mapping[Any, Callable[[str], Any]] = types.MappingProxyType(
    {int: _whole, float: _number, str: str, tuple[float, ...]: _numbers}
)
