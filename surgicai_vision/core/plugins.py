"""Plug-ins: the parts of the toolkit by name, ours and those of other distributions.

A registry gets its parts from three places, in this order:

1. the table of this distribution, "module:attribute" by name, imported on first use;
2. `register(name, part)`, called by whoever imports this package;
3. the entry points of installed distributions in the registry's group, read with
   importlib.metadata on the first look-up:

       [project.entry-points."surgicai_vision.encoders"]
       my-encoder = "my_package.my_encoder:PLUGIN"

Two parts with one name are refused with an error that names both distributions. A part that is not
of the registry's kind is refused too, and an error from a part's own code names the part and its
distribution (`Registry.calling`).

    ENCODERS = Registry[Plugin](
        "encoder", ENCODERS_GROUP, {"random": "encoders.random_resnet:RANDOM"}
    )
    ENCODERS.names()            # without importing any part
    ENCODERS.load("random")     # imported, or `UnknownName` with the nearest name
"""

import functools
import importlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, cast, final

from surgicai_vision.core.errors import (
    InputError,
    SurgicaiError,
    check_name,
    first_line,
    shown,
)

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint, EntryPoints

DISTRIBUTION: Final = "surgicai-vision"
ENCODERS_GROUP: Final = "surgicai_vision.encoders"
POLICIES_GROUP: Final = "surgicai_vision.policies"
TASKS_GROUP: Final = "surgicai_vision.tasks"
CAMERAS_GROUP: Final = "surgicai_vision.cameras"
ENGINES_GROUP: Final = "surgicai_vision.engines"

type Fault = Callable[[object], str]
"""What is wrong with a part, as the end of a sentence that begins with its name; "" if nothing."""


class NameCollision(InputError):
    """Two distributions offer a part of the same kind under the same name, or one does twice."""

    def __init__(self, kind: str, name: str, first: str, second: str):
        super().__init__(
            f"The {kind} '{name}' is offered by '{first}' and by '{second}'; "
            "uninstall one of them or ask its author for another name."
            if first != second
            else f"The {kind} '{name}' is offered twice by '{first}'; give it another name, or "
            "start Python anew to replace it."
        )


def instance_of(target: str) -> Fault:
    """Return a function that finds the fault of a part that is no instance of "module:Class"."""

    def fault(part: object) -> str:
        if isinstance(part, resolve(target)):
            return ""
        return f"is {shown(part)}; it must be an instance of {_public(target)}"

    return fault


def subclass_of(target: str) -> Fault:
    """Return a function that finds the fault of what is no concrete subclass of "module:Class"."""

    def fault(part: object) -> str:
        if not isinstance(part, type) or not issubclass(part, resolve(target)):
            return f"is {shown(part)}; it must be a subclass of {_public(target)}"
        if inspect.isabstract(part):
            missing = ", ".join(sorted(getattr(part, "__abstractmethods__", ())))
            return f"lacks what {_public(target)} requires: {missing}"
        return ""

    return fault


def uncallable(part: object, name: str) -> str:
    """Return the fault of a part whose attribute `name` is not callable; "" if it is."""
    value: object = getattr(part, name)
    return "" if callable(value) else f"has a {name} that is {shown(value)}; it must be a function"


def _fits(part: object) -> str:
    """Return "", no fault, for any part."""
    return ""


def _public(target: str) -> str:
    """Return the name of a class as the reference pages write it."""
    return target.replace(":", ".")


@final
class Registry[Part]:
    """Parts of one kind by name.

    Args:
        kind: what a part is, in one word ("encoder"), for messages.
        group: entry-point group in which other distributions offer parts of this kind.
        ours: name → "module:attribute" of the parts of this distribution.
        fault: finds what is wrong with a part that is registered or from another distribution.
    """

    def __init__(self, kind: str, group: str, ours: Mapping[str, str], fault: Fault = _fits):
        self.kind = kind
        self.group = group
        self._fault = fault
        self._targets: dict[str, tuple[str, Callable[[], object]]] = {
            name: (DISTRIBUTION, functools.partial(resolve, target))
            for name, target in ours.items()
        }
        self._collisions: dict[str, NameCollision] = {}
        self._is_searched = False

    def names(self) -> tuple[str, ...]:
        """Return every name: ours, then registered ones, then those of installed distributions.

        A name that two distributions offer is included as well; only its use is refused.
        """
        self._search()
        return tuple(self._targets)

    def check(self, name: str) -> str:
        """Return `name` if a part has it; import no part.

        Raises:
            UnknownName: no part has this name.
            NameCollision: two distributions offer one.
        """
        check_name(self.kind, name, self.names())
        if name in self._collisions:
            raise self._collisions[name]
        return name

    def load(self, name: str) -> Part:
        """Return the part called `name`, imported on first use.

        Raises:
            UnknownName: no part has this name.
            NameCollision: two distributions offer one.
            InputError: another distribution's part cannot be imported, or is not of this kind.
        """
        self.check(name)
        distribution, load = self._targets[name]
        if distribution == DISTRIBUTION:
            return cast(Part, load())
        try:
            part = load()
        except Exception as error:  # a third-party module may raise anything
            raise self.refusal(name, f"cannot be imported: {_reason(error)}") from error
        return self._checked(name, distribution, part)

    def register(self, name: str, part: Part, distribution: str = "") -> None:
        """Offer `part` under `name` in this process.

        Args:
            name: the new name.
            part: the part itself.
            distribution: who offers it, for messages; "register_<kind>()" by default.

        Raises:
            NameCollision: the name is taken.
            InputError: the part is not of this kind.
        """
        self._search()
        owner = distribution or f"register_{self.kind}()"
        self._checked(name, owner, part)
        self._add(name, owner, lambda: part)

    def unregister(self, name: str) -> None:
        """Forget the part called `name`; for tests that register parts."""
        self._targets.pop(name, None)

    def owner(self, name: str) -> str:
        """Return the distribution that offers the part called `name`."""
        self.check(name)
        return self._targets[name][0]

    def is_ours(self, name: str) -> bool:
        """Return True unless another distribution, or a script, offers the part called `name`."""
        return self.distribution(name) == DISTRIBUTION

    def distribution(self, name: str) -> str:
        """Return the first distribution that offers `name`; ours for an unknown name."""
        return self._targets[name][0] if name in self._targets else DISTRIBUTION

    def refusal(self, name: str, reason: str) -> InputError:
        """Return the error that names a part and its distribution and says why it is unusable.

        Args:
            name: of the part.
            reason: the end of the sentence that begins with it, without a full stop.
        """
        return InputError(f"{self._title(name)} {reason.removesuffix('.')}.")

    @contextmanager
    def calling(self, name: str) -> Iterator[None]:
        """Let an error of the part's own code, which runs in the block, name the part.

        Errors of this product keep their type and get the part's name as a prefix; any other
        becomes an `InputError`, with its traceback as a note. Errors of our own parts stay as they
        are.

        Args:
            name: of the part.
        """
        try:
            yield
        except SurgicaiError as error:
            if not self.is_ours(name):
                error.args = (f"{self._title(name)}: {error}",)
            raise
        except Exception as error:  # third-party code may raise anything
            if self.is_ours(name):
                raise
            refusal = self.refusal(name, f"failed: {_reason(error)}")
            refusal.add_note("".join(traceback.format_exception(error)).rstrip())
            raise refusal from error

    def _checked(self, name: str, owner: str, part: object) -> Part:
        """Return `part` if it is of this kind, else refuse it."""
        if fault := self._fault(part):
            raise InputError(f"{self._title(name, owner)} {fault}.")
        return cast(Part, part)

    def _title(self, name: str, owner: str = "") -> str:
        """Return how a message names a part."""
        return f"The {self.kind} '{name}' of '{owner or self.distribution(name)}'"

    def _search(self) -> None:
        """Read the entry points of the group, once; record name collisions."""
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
def _installed(path: tuple[str, ...]) -> "EntryPoints":
    """Return the entry points of every distribution on `path`, which is `sys.path`."""
    from importlib.metadata import entry_points  # not at the top: it is most of the start-up time

    return entry_points()


def _owner(point: "EntryPoint") -> str:
    """Return the name of the distribution of an entry point."""
    return point.dist.name if point.dist is not None else point.module.partition(".")[0]


def _reason(error: Exception) -> str:
    """Return an error of third-party code in one line: its type, its text and where it arose."""
    said = first_line(error).removesuffix(".")
    if isinstance(error, SurgicaiError | ImportError):
        return said
    text = (
        type(error).__name__ if said == type(error).__name__ else f"{type(error).__name__}: {said}"
    )
    frames = traceback.extract_tb(error.__traceback__)
    if not frames or "importlib" in frames[-1].filename:
        return text
    return f"{text} ({frames[-1].filename}, line {frames[-1].lineno})"


def resolve(target: str) -> Any:
    """Import "module:attribute"."""
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
