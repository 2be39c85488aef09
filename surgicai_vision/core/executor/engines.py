"""The table of engines, by their names on the command line.

For example:

    open_engine("local")
    open_engine("slurm,partition=cpu,minutes=60")
"""

import dataclasses
from typing import Final

from surgicai_vision.core.config import from_mapping, read_changes
from surgicai_vision.core.errors import InputError, shown
from surgicai_vision.core.executor.engine import Engine
from surgicai_vision.core.plugins import ENGINES_GROUP, Registry, subclass_of

ENGINES: Final = Registry[type[Engine]](
    "executor",
    ENGINES_GROUP,
    {
        "local": "surgicai_vision.core.executor.local:LocalEngine",
        "ray": "surgicai_vision.core.executor.ray:RayEngine",
        "slurm": "surgicai_vision.core.executor.slurm:SlurmEngine",
    },
    subclass_of("surgicai_vision.core.executor.engine:Engine"),
)


def register_engine(engine: type[Engine]) -> None:
    """Offer an engine under its name in this process.

    Raises:
        NameCollision: the name is taken.
        InputError: this is not an engine.
    """
    name = getattr(engine, "name", shown(engine))
    owner = getattr(engine, "__module__", "").partition(".")[0]
    ENGINES.register(name, engine, owner or "register_engine()")


def open_engine(text: str) -> Engine:
    """Return the engine that a text names, with its options: "NAME" or "NAME,KEY=VALUE,…".

    Raises:
        UnknownName: an engine or an option that does not exist.
        InputError: a value that is not allowed, a package that is missing, or an error of another
            distribution's engine.
    """
    name, *options = text.split(",")
    engine = ENGINES.load(name)
    if options and not dataclasses.fields(engine):
        raise InputError(f"--executor {name} takes no options; leave '{options[0]}' out.")
    changes = read_changes(options)
    with ENGINES.calling(name):
        return from_mapping(engine, changes, f"--executor {name}")
