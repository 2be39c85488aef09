"""What the options of all commands share: traits, comma lists and the `--config` file.

The options of a command are a frozen dataclass; cyclopts reads its fields, their types and the
`Attributes:` of its docstring. A trait below is a `cyclopts.Parameter` with what several options
have in common. It stands in the annotation beside the type, and may be combined with others:

    episodes: Annotated[int, COUNT] = 20
    view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")

What is one option in several commands is a whole type, with its help and its default's text:

    weights: WeightFiles = ()

A value is taken from the command line, else from the `--config` file, else from the dataclass.
"""

import os
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter, Token, validators
from cyclopts.argument import Argument, ArgumentCollection

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.config import LARGEST_INTEGER, TaskConfig, convert, from_mapping
from surgicai_vision.core.errors import InputError, UnknownName, shown
from surgicai_vision.core.files import read_yaml
from surgicai_vision.core.tasks import task_names
from surgicai_vision.features import devices, encoders

Source = Callable[[App, tuple[str, ...], ArgumentCollection], None]
"""What cyclopts calls between reading the command line and converting the texts to values."""


def _whole_number(_: type, tokens: Sequence[Token]) -> int:
    """Convert a text to an int; cyclopts itself would round 3.5."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected a whole number, got '{tokens[0].value}'.") from None


def _refuse_repetition(_: type, values: Sequence[object] | None) -> None:
    """Raise ValueError if a list holds a value twice."""
    given = values or ()
    for value in given:
        if given.count(value) > 1:
            raise ValueError(f"'{value}' is given twice; give it once.")


def _refuse_text(_: type, tokens: Sequence[Token]) -> None:
    """Raise ValueError: a table cannot be given on the command line."""
    raise ValueError(f"'{tokens[0].value}' is given, but this table stands in a --config file.")


def _check_encoder(_: type, name: str) -> None:
    encoders.check_encoder_name(name)


def _check_encoders(_: type, given: Sequence[str]) -> None:
    for name in given:
        encoders.check_encoder_name(name)


def _show_list(values: Sequence[object]) -> str:
    """Return the default of a comma list as it would be typed."""
    shown = (f"{value:g}" if isinstance(value, float) else str(value) for value in values)
    return ",".join(shown) or "none"


def within(low: int, high: int) -> Parameter:
    """Return the trait of a whole number from `low` to `high`."""
    return Parameter(
        converter=_whole_number, validator=validators.Number(gte=low, lte=high), metavar="N"
    )


TASK = Parameter(choices=task_names())
SUBTASK = Parameter(choices=names.SUBTASKS)
DIRECTORY = Parameter(metavar="DIR")
COUNT = Parameter(converter=_whole_number, validator=validators.Number(gte=1), metavar="N")
NOT_NEGATIVE = Parameter(converter=_whole_number, validator=validators.Number(gte=0), metavar="N")
SEED = within(0, LARGEST_INTEGER)
"""Seed of a training, or of the first start: no row holds a larger one."""
FRACTION = Parameter(validator=validators.Number(gte=0, lte=1), metavar="P")
IMAGE_SIZE = Parameter.combine(within(16, 960), Parameter(metavar="PX"))
"""Height and width [px] that the renderer has room for."""
LIST = Parameter(show_default=_show_list)
UNIQUE = Parameter(show_default=_show_list, validator=_refuse_repetition)
"""A comma list that holds nothing twice."""
VIEWS = Parameter.combine(UNIQUE, Parameter(choices=camera_names(), metavar="VIEW[,VIEW]"))
VIDEO = Parameter(
    help="Store RGB as video; the error is measured.", choices=("h264", "av1"), metavar="CODEC"
)
ENCODER = Parameter(
    help=f"One of {encoders.encoder_choices()}.", validator=_check_encoder, metavar="NAME"
)
ENCODERS = Parameter(
    help=f"Encoders, of {encoders.encoder_choices()}.",
    validator=_check_encoders,
    show_default=_show_list,
    metavar="NAME[,NAME]",
)
POOL = Parameter(choices=encoders.POOLS)
DEVICE = Parameter(choices=devices.DEVICES)
EXECUTOR = Parameter(
    help="What runs the jobs: local, ray or slurm, with its options, such as ray,address=HOST:PORT "
    "or slurm,partition=cpu,minutes=60.",
    metavar="NAME[,KEY=VALUE]",
)
"""`executor.open_engine` reads it."""
FILE_ONLY = Parameter(accepts_keys=False, converter=_refuse_text, show=False)
"""A table that only the `--config` file can give."""


def default_text(text: str) -> Parameter:
    """Return a trait that says what an option without a value of its own defaults to."""
    return Parameter(show_default=text)


PolicyName = Annotated[
    str,
    Parameter(
        help="A checkpoint folder, a hierarchical.yaml, released:NAME (see `policies`), "
        "module:factory, or expert, replay, random or zero.",
        metavar="POLICY",
    ),
]
"""What `evaluation.policy_spec.open_policy` takes."""
PolicyTask = Annotated[str | None, TASK, default_text("the checkpoint's, else grasp")]
EvaluationWorkers = Annotated[
    int | None, COUNT, default_text("one a core, at most one for four episodes")
]
DatasetFolder = Annotated[Path | None, DIRECTORY, default_text("outputs/datasets/<task>")]
WeightFiles = Annotated[
    tuple[str, ...],
    Parameter(
        help="File with the encoder's pretrained weights; NAME=FILE for the encoder NAME alone; "
        "repeat it for another encoder.",
        metavar="[NAME=]FILE",
        show_default=False,
    ),
]
"""`encoders.WeightsSource.parse` reads them, with the next."""
AcceptLicence = Annotated[bool, Parameter(help="Accept weights under a non-commercial licence.")]
EnvFields = Annotated[dict[str, object] | None, FILE_ONLY]
"""Fields of `TaskConfig` that differ; `task_config` or `open_policy` reads them."""


def task_config(task: str, env: dict[str, object] | None) -> TaskConfig:
    """Return the configuration of `task`, changed by the table `env` of a `--config` file.

    Raises:
        UnknownName: a key that `TaskConfig` does not have.
        InputError: a value that is not allowed, or the task itself, which is an option of its own.
    """
    changes = env or {}
    if "task" in changes:
        raise InputError("env: the task is an option of its own; write `task:` beside `env:`.")
    return from_mapping(TaskConfig, {**changes, "task": task}, "env")


def split_comma_lists(_: App, __: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Give every part of a comma list on the command line a token of its own."""
    for argument in arguments:
        if _is_list(argument):
            argument.tokens = [
                token.evolve(value=part)
                for token in argument.tokens
                for part in _parts(token.value, argument.name)
            ]


def from_file(path: Path) -> Source:
    """Return a source that gives every option left out its value in the YAML file `path`."""

    def fill(_: App, __: tuple[str, ...], arguments: ArgumentCollection) -> None:
        known = {_key(argument): argument for argument in arguments if argument.keys}
        for key, value in read_yaml(path).items():
            if key not in known:
                raise UnknownName(f"key in {path}", key, known)
            argument = known[key]
            tokens = [
                token.evolve(source=str(path)) for token in _tokens(argument, key, value, path)
            ]
            if not argument.tokens:
                argument.tokens = tokens

    return fill


def _key(argument: Argument) -> str:
    """Return how an option is called in a file."""
    return argument.name.lstrip("-").replace("-", "_")


def _is_list(argument: Argument) -> bool:
    """Return True if the option takes a comma list."""
    is_tuple = typing.get_origin(argument.resolved_hint) is tuple
    return is_tuple and argument.parameter.accepts_keys is not False


def _parts(text: str, name: str) -> list[str]:
    """Return the parts of a comma list.

    Raises:
        InputError: the list is empty, or nothing stands before, between or after two commas.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(parts):
        problem = f"is '{text}'; expected names between commas" if len(parts) > 1 else "is empty"
        raise InputError(f"{name} {problem}.")
    return parts


def _tokens(argument: Argument, key: str, value: object, path: Path) -> list[Token]:
    """Return a file's value as the texts that would stand on the command line, where it has such.

    Raises:
        InputError: the value is of another type than the option.
    """
    where = f"{path}: {key}"
    hint = argument.resolved_hint
    if value is None and type(None) in typing.get_args(argument.hint):
        is_default = argument.field_info.default is None
        return [] if is_default else [Token(keyword=key, implicit_value=None)]
    if _is_list(argument):
        if isinstance(value, str):
            texts = _parts(value, where)
        else:
            listed = convert(_written_as(hint), value, where)
            assert isinstance(listed, tuple)
            texts = [str(part) for part in listed]
        if texts:
            return [Token(keyword=key, value=_writable(text, where)) for text in texts]
        return [Token(keyword=key, implicit_value=())]
    value = convert(_written_as(hint), value, where)
    if isinstance(value, str):
        return [Token(keyword=key, value=_writable(value, where))]
    return [Token(keyword=key, implicit_value=value)]


def _writable(text: str, where: str) -> str:
    """Return a text of a file that a command line, and so the name of a file, can hold.

    Raises:
        InputError: it holds a NUL, or half of a character (a lone surrogate).
    """
    try:
        encoded = os.fsencode(text)
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise InputError(
            f"{where}: {shown(text)} holds a character that no name has; leave it out."
        )
    return text


def _written_as(hint: type) -> type:
    """Return the type that a file holds where an option has type `hint`."""
    if hint is Path:
        return str
    return tuple[str, ...] if hint == tuple[Path, ...] else hint
