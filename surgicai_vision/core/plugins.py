"""Plug-ins: the parts of the toolkit by name, ours and those of other distributions.

A registry knows its parts from three places, in this order:

1. the table of this distribution, "module:attribute" by name, imported on first use;
2. `register(name, part)`, called by whoever imports this package;
3. the entry points of installed distributions in the registry's group, read with
   importlib.metadata on the first look-up:

       [project.entry-points."surgicai_vision.encoders"]
       my-encoder = "my_package.my_encoder:PLUGIN"

Two parts of one name are refused with an error that names both distributions.

    ENCODERS = Registry[Plugin](
        "encoder", ENCODERS_GROUP, {"random": "encoders.random_resnet:RANDOM"}
    )
    ENCODERS.names()            # without importing any part
    ENCODERS.load("random")     # imported, or `UnknownName` with the nearest name
"""

import functools
import importlib
import sys
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from typing import Any, Final, cast, final

from surgicai_vision.core.errors import InputError, check_name

DISTRIBUTION: Final = "surgicai-vision"
ENCODERS_GROUP: Final = "surgicai_vision.encoders"
POLICIES_GROUP: Final = "surgicai_vision.policies"
TASKS_GROUP: Final = "surgicai_vision.tasks"
CAMERAS_GROUP: Final = "surgicai_vision.cameras"
ENGINES_GROUP: Final = "surgicai_vision.engines"


class NameCollision(InputError):
    """Two distributions offer a part of the same kind under the same name."""

    def __init__(self, kind: str, name: str, first: str, second: str):
        super().__init__(
            f"The {kind} '{name}' is offered by '{first}' and by '{second}'; "
            "uninstall one of them or ask its author for another name."
        )


@final
class Registry[Part]:
    """Parts of one kind by name.

    Args:
        kind: what a part is, in one word ("encoder"), for messages.
        group: entry-point group in which other distributions offer parts of this kind.
        ours: name → "module:attribute" of the parts of this distribution.
    """

    def __init__(self, kind: str, group: str, ours: Mapping[str, str]):
        self.kind = kind
        self.group = group
        self._targets: dict[str, tuple[str, Callable[[], object]]] = {
            name: (DISTRIBUTION, functools.partial(resolve, target))
            for name, target in ours.items()
        }
        self._collisions: dict[str, NameCollision] = {}
        self._is_searched = False

    def names(self) -> tuple[str, ...]:
        """Return every name: ours, then registered ones, then those of installed distributions.

        A name that two distributions offer is there as well; only its use is refused.
        """
        self._search()
        return tuple(self._targets)

    def check(self, name: str) -> str:
        """Return `name` if a part is called so; imports no part.

        Raises:
            UnknownName: no part is called so.
            NameCollision: two distributions offer one.
        """
        check_name(self.kind, name, self.names())
        if name in self._collisions:
            raise self._collisions[name]
        return name

    def load(self, name: str) -> Part:
        """Return the part called `name`, imported on first use.

        Raises:
            UnknownName: no part is called so.
            NameCollision: two distributions offer one.
            InputError: another distribution's part cannot be imported.
        """
        self.check(name)
        distribution, load = self._targets[name]
        try:
            return cast(Part, load())
        except (ImportError, AttributeError) as error:
            if distribution == DISTRIBUTION:
                raise
            raise InputError(
                f"The {self.kind} '{name}' of '{distribution}' cannot be imported: {error}."
            ) from error

    def register(self, name: str, part: Part, distribution: str = "") -> None:
        """Offer `part` under `name` in this process.

        Args:
            name: the new name.
            part: the part itself.
            distribution: who offers it, for messages; "register_<kind>()" by default.

        Raises:
            NameCollision: the name is taken.
        """
        self._search()
        self._add(name, distribution or f"register_{self.kind}()", lambda: part)

    def unregister(self, name: str) -> None:
        """Forget the part called `name`; for tests of parts that are registered in them."""
        self._targets.pop(name, None)

    def owner(self, name: str) -> str:
        """Return the distribution that offers the part called `name`."""
        self.check(name)
        return self._targets[name][0]

    def _search(self) -> None:
        """Read the entry points of the group, once; note names that are taken."""
        if self._is_searched:
            return
        self._is_searched = True
        for point in _installed(tuple(sys.path)).select(group=self.group):
            try:
                self._add(point.name, _owner(point), point.load)
            except NameCollision as collision:
                self._collisions[point.name] = collision

    def _add(self, name: str, owner: str, load: Callable[[], object]) -> None:
        if name in self._targets:
            raise NameCollision(self.kind, name, self._targets[name][0], owner)
        self._targets[name] = (owner, load)


@functools.cache
def _installed(path: tuple[str, ...]) -> EntryPoints:
    """Return the entry points of every distribution on `path`, which is `sys.path`."""
    return entry_points()


def _owner(point: EntryPoint) -> str:
    """Return the name of the distribution of an entry point."""
    return point.dist.name if point.dist is not None else point.module.partition(".")[0]


def resolve(target: str) -> Any:
    """Import "module:attribute"."""
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
