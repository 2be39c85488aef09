"""What the options of all commands share: traits, comma lists and the `--config` file.

The options of a command are a frozen dataclass; cyclopts reads its fields, their types and the
`Attributes:` of its docstring. A trait below is a `cyclopts.Parameter` with what several options
have in common. It is part of the annotation, next to the type, and may be combined with others:

    episodes: Annotated[int, COUNT] = 20
    view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")

An option that several commands share is a complete type, with its help and its default's text:

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
"""What cyclopts calls after reading the command line and before converting texts to values."""


def _whole_number(_: type, tokens: Sequence[Token]) -> int:
    """Convert a text to an int; cyclopts itself would round 3.5."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected a whole number, got '{tokens[0].value}'.") from None


def _whole_numbers(_: type, tokens: Sequence[Token]) -> tuple[int, ...]:
    """Convert texts to integers; cyclopts itself would round 3.5."""
    return tuple(_whole_number(int, [token]) for token in tokens)


def _refuse_repetition(_: type, values: Sequence[object] | None) -> None:
    """Raise ValueError if a list holds a value twice."""
    given = values or ()
    for value in given:
        if given.count(value) > 1:
            raise ValueError(f"'{value}' is given twice; give it once.")


def _refuse_text(_: type, tokens: Sequence[Token]) -> None:
    """Raise ValueError: a table cannot be given on the command line."""
    raise ValueError(f"'{tokens[0].value}' is given, but this table belongs in a --config file.")


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
"""Seed of a training or of the first start; a row cannot hold a larger number."""
DURATION = Parameter(validator=validators.Number(gt=0, lte=1e6), metavar="S")
"""A time [s], at most eleven days."""
FRACTION = Parameter(validator=validators.Number(gte=0, lte=1), metavar="P")
IMAGE_SIZE = Parameter.combine(within(16, 960), Parameter(metavar="PX"))
"""Height and width [px] within the limits of the renderer."""
LIST = Parameter(show_default=_show_list)
UNIQUE = Parameter(show_default=_show_list, validator=_refuse_repetition)
"""A comma list without repeated values."""
WHOLE_NUMBERS = Parameter.combine(UNIQUE, Parameter(converter=_whole_numbers, metavar="N[,N]"))
VIEWS = Parameter.combine(UNIQUE, Parameter(choices=camera_names(), metavar="VIEW[,VIEW]"))
VIDEO = Parameter(
    help="Store RGB as video with this codec; the error is measured.",
    choices=("h264", "av1"),
    metavar="CODEC",
)
ENCODER = Parameter(
    help=f"Encoder: {encoders.encoder_choices()}.", validator=_check_encoder, metavar="NAME"
)
ENCODERS = Parameter(
    help=f"Encoders, any of {encoders.encoder_choices()}.",
    validator=_check_encoders,
    show_default=_show_list,
    metavar="NAME[,NAME]",
)
POOL = Parameter(choices=encoders.POOLS)
DEVICE = Parameter(choices=devices.DEVICES)
EXECUTOR = Parameter(
    help="What runs the jobs: local, ray or slurm, and its options, such as ray,address=HOST:PORT "
    "or slurm,partition=cpu,minutes=60.",
    metavar="NAME[,KEY=VALUE]",
)
"""Read by `executor.open_engine`."""
FILE_ONLY = Parameter(accepts_keys=False, converter=_refuse_text, show=False)
"""A table that only the `--config` file can give."""


def default_text(text: str) -> Parameter:
    """Return a trait with the text that `--help` shows as the option's default."""
    return Parameter(show_default=text)


PolicyName = Annotated[
    str,
    Parameter(
        help="The policy: a checkpoint folder, a hierarchical.yaml, released:NAME (see "
        "`policies`), module:factory, or one of expert, recover, replay, random and zero.",
        metavar="POLICY",
    ),
]
"""What `evaluation.policy_spec.open_policy` takes."""
PolicyTask = Annotated[str | None, TASK, default_text("the checkpoint's, else grasp")]
EvaluationWorkers = Annotated[
    int | None, COUNT, default_text("one per core, at most one per four episodes")
]
DetectorName = Annotated[
    str | None,
    Parameter(
        help="Folder of a detector, or released:detector; crops are then cut where it sees the "
        "jaws (docs/detection.md).",
        metavar="DIR",
    ),
    default_text("none: crops lie where the arm reports its jaws"),
]
DatasetFolder = Annotated[Path | None, DIRECTORY, default_text("outputs/datasets/<task>")]
WeightFiles = Annotated[
    tuple[str, ...],
    Parameter(
        help="File with the encoder's pretrained weights; NAME=FILE is for encoder NAME only. May "
        "be repeated.",
        metavar="[NAME=]FILE",
        show_default=False,
    ),
]
"""Read by `encoders.WeightsSource.parse`, together with `AcceptLicence`."""
AcceptLicence = Annotated[bool, Parameter(help="Accept weights under a non-commercial licence.")]
ActingChanges = Annotated[
    tuple[str, ...],
    Parameter(
        help="Values of speed, jaw_speed, pinch_speed, clock_speed, retry_after and denoise and, "
        "for a policy that plans chunks, of execute, samples, ensemble and measure_delay to use "
        "instead of its recipe's.",
        metavar="KEY=VALUE[,KEY=VALUE]",
    ),
    default_text("none"),
]
"""Settings of a recipe that do not affect what is learned (`ACTED_BY`); read by `open_policy`."""
EnvFields = Annotated[dict[str, object] | None, FILE_ONLY]
"""Fields of `TaskConfig` to change; read by `task_config` or `open_policy`."""


def task_config(task: str, env: dict[str, object] | None) -> TaskConfig:
    """Return the configuration of `task`, changed by the table `env` of a `--config` file.

    Raises:
        UnknownName: a key that `TaskConfig` does not have.
        InputError: a value that is not allowed, or the task itself, which has its own option.
    """
    changes = env or {}
    if "task" in changes:
        raise InputError("env: the task is a separate option; write `task:` next to `env:`.")
    return from_mapping(TaskConfig, {**changes, "task": task}, "env")


def split_comma_lists(_: App, __: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Give every part of a comma list on the command line its own token."""
    for argument in arguments:
        if _is_list(argument):
            argument.tokens = [
                token.evolve(value=part)
                for token in argument.tokens
                for part in _parts(token.value, argument.name)
            ]


def from_file(path: Path) -> Source:
    """Return a source that fills in every option left out from the YAML file `path`."""

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
    """Return the key of an option in a file."""
    return argument.name.lstrip("-").replace("-", "_")


def _is_list(argument: Argument) -> bool:
    """Return True if the option takes a comma list."""
    is_tuple = typing.get_origin(argument.resolved_hint) is tuple
    return is_tuple and argument.parameter.accepts_keys is not False


def _parts(text: str, name: str) -> list[str]:
    """Return the parts of a comma list.

    Raises:
        InputError: the list is empty, or has an empty part.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(parts):
        problem = f"is '{text}'; separate the names by commas" if len(parts) > 1 else "is empty"
        raise InputError(f"{name} {problem}.")
    return parts


def _tokens(argument: Argument, key: str, value: object, path: Path) -> list[Token]:
    """Return a file's value as tokens, with the text of a command line where it has one.

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
    """Return a file's text, if a command line, and thus the name of a file, can hold it.

    Raises:
        InputError: it holds a NUL, or half of a character (a lone surrogate).
    """
    try:
        encoded = os.fsencode(text)
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise InputError(
            f"{where}: {shown(text)} contains a character that no name can contain; leave it out."
        )
    return text


def _written_as(hint: type) -> type:
    """Return the type in a file of an option of type `hint`."""
    if hint is Path:
        return str
    return tuple[str, ...] if hint == tuple[Path, ...] else hint
