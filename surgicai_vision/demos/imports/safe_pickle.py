"""Safe pickles: numpy arrays, dtypes and plain containers, nothing else.

    tree = unpickle(content, "demos.pkl")     # dict, list, tuple, str, bytes, numbers, numpy arrays

A pickle is a program. Here it is read twice. First its instructions are listed without running any:
a global outside `ADMITTED`, an instruction that could create other objects, or a memo built to
exhaust memory is refused by name. Then it is run by an unpickler whose globals are not numpy's
functions but the small stand-ins below, which check every argument and build arrays from bytes
themselves. Numpy's own state setters never see untrusted data, and object arrays (arrays of further
pickled objects) are refused.

Every refusal is a `BadFile` with a one-line message.
"""

import io
import math
import pickle
import pickletools
import re
from types import MappingProxyType
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import BadFile

MAX_BYTES = 64 * 2**20
"""Largest file that is read; SurgicAI's own are below 4 MB."""

MAX_DEPTH = 16
"""Deepest nesting of containers; SurgicAI's is 4."""

_NUMPY = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")

_STRINGS = (
    "STRING",
    "BINSTRING",
    "SHORT_BINSTRING",
    "UNICODE",
    "SHORT_BINUNICODE",
    "BINUNICODE",
    "BINUNICODE8",
)
_OPCODES = frozenset(
    (
        *_STRINGS,
        "PROTO",
        "FRAME",
        "STOP",
        "MARK",
        "POP",
        "POP_MARK",
        "DUP",
        "NONE",
        "NEWTRUE",
        "NEWFALSE",
        "INT",
        "BININT",
        "BININT1",
        "BININT2",
        "LONG",
        "LONG1",
        "LONG4",
        "FLOAT",
        "BINFLOAT",
        "BINBYTES",
        "SHORT_BINBYTES",
        "BINBYTES8",
        "EMPTY_LIST",
        "LIST",
        "APPEND",
        "APPENDS",
        "EMPTY_TUPLE",
        "TUPLE",
        "TUPLE1",
        "TUPLE2",
        "TUPLE3",
        "EMPTY_DICT",
        "DICT",
        "SETITEM",
        "SETITEMS",
        "GET",
        "BINGET",
        "LONG_BINGET",
        "PUT",
        "BINPUT",
        "LONG_BINPUT",
        "MEMOIZE",
        "GLOBAL",
        "STACK_GLOBAL",
        "REDUCE",
        "BUILD",
    )
)
"""Instructions needed by a pickle of arrays and containers; those that create instances, extensions
or persistent objects are not included."""


class _Ndarray:
    """Stands for the class numpy.ndarray, which a pickle passes to `_reconstruct`."""

    __slots__ = ()


class _Array:
    """An unfinished array, which a pickle fills by calling `__setstate__`."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value: NDArray[np.generic] | None = None

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            _refuse("an array's state is not the five values numpy writes")
        version, shape, dtype, fortran, content = state
        if version != 1 or not isinstance(shape, tuple) or not isinstance(dtype, _Dtype):
            _refuse("an array's state is not what numpy writes")
        if not all(isinstance(side, int) and 0 <= side < 2**40 for side in shape) or len(shape) > 5:
            _refuse("an array's shape is invalid")
        content = content.encode("latin-1") if isinstance(content, str) else content
        if not isinstance(content, bytes):
            _refuse("an array holds objects, not numbers")
        kind = dtype.numpy()
        if math.prod(shape) * kind.itemsize != len(content):
            _refuse(f"an array of shape {shape} and type {kind} has {len(content)} bytes")
        self.value = np.frombuffer(content, kind).reshape(shape, order="F" if fortran else "C")


class _Dtype:
    """An unfinished dtype: its code comes from the call, its byte order from the state."""

    __slots__ = ("code", "order")

    def __init__(self, code: str):
        self.code = code
        self.order = "="

    def __setstate__(self, state: object) -> None:
        if (
            not isinstance(state, tuple)
            or len(state) not in (7, 8)
            or state[2:5] != (None, None, None)
            or state[1] not in ("<", ">", "=", "|")
        ):
            _refuse("a dtype's state is not that of a plain number")
        self.order = state[1]

    def numpy(self) -> np.dtype[np.generic]:
        """Return the numpy dtype."""
        return np.dtype((self.order if self.order != "|" else "=") + self.code.lstrip("<>=|"))


class _Reconstruct:
    """Stands for numpy.core.multiarray._reconstruct, called as (ndarray, (0,), b"b")."""

    __slots__ = ()

    def __call__(self, *arguments: object) -> _Array:
        if len(arguments) != 3 or not isinstance(arguments[0], _Ndarray) or arguments[1] != (0,):
            _refuse("an array is not made the way numpy makes it")
        return _Array()


class _MakeDtype:
    """Stands for the class numpy.dtype, called as ("f4", False, True)."""

    __slots__ = ()

    def __call__(self, *arguments: object) -> _Dtype:
        code = arguments[0] if arguments else None
        if not isinstance(code, str) or not _NUMPY.fullmatch(code):
            _refuse(f"dtype {str(code)[:40]!r} is not that of plain numbers")
        return _Dtype(str(code))


class _Scalar:
    """Stands for numpy.core.multiarray.scalar, called as (dtype, bytes)."""

    __slots__ = ()

    def __call__(self, *arguments: object) -> np.generic:
        if len(arguments) != 2 or not isinstance(arguments[0], _Dtype):
            _refuse("a number is not made the way numpy makes it")
        content = arguments[1].encode("latin-1") if isinstance(arguments[1], str) else arguments[1]
        kind = arguments[0].numpy()
        if not isinstance(content, bytes) or len(content) != kind.itemsize:
            _refuse(f"a number of type {kind} has the wrong length")
        number: np.generic = np.frombuffer(content, kind)[0]
        return number


ADMITTED = MappingProxyType(
    {
        ("numpy.core.multiarray", "_reconstruct"): _Reconstruct(),
        ("numpy._core.multiarray", "_reconstruct"): _Reconstruct(),
        ("numpy.core.multiarray", "scalar"): _Scalar(),
        ("numpy._core.multiarray", "scalar"): _Scalar(),
        ("numpy", "ndarray"): _Ndarray(),
        ("numpy", "dtype"): _MakeDtype(),
    }
)
"""Global → its stand-in. Everything else is refused."""


class _Unpickler(pickle.Unpickler):
    """The only unpickler of the project: its globals are `ADMITTED`."""

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in ADMITTED:
            _refuse_global(module, name)
        return ADMITTED[module, name]


def unpickle(content: bytes, where: str) -> object:
    """Return the plain data in a pickle.

    Args:
        content: the file's bytes.
        where: the file's name, for messages.

    Raises:
        BadFile: not a pickle, truncated, too large, or one that holds anything but arrays and
            containers.
    """
    if not content:
        raise BadFile(f"{where} is empty.")
    if len(content) > MAX_BYTES:
        raise BadFile(
            f"{where} has {len(content) / 2**20:.0f} MB; "
            f"pickles above {MAX_BYTES >> 20} MB are not read."
        )
    try:
        _inspect(content)
        return _plain(_Unpickler(io.BytesIO(content), encoding="latin1").load(), {}, 0)
    except BadFile as error:
        raise BadFile(f"{where} is refused: {error}") from None
    except MemoryError:
        raise BadFile(f"{where} is refused: it asks for more memory than there is.") from None
    except Exception as error:  # a damaged pickle can fail in any way
        line = (str(error).splitlines() or [""])[0][:120]
        raise BadFile(
            f"{where} is not a readable pickle ({type(error).__name__}: {line})."
        ) from None


def _inspect(content: bytes) -> None:
    """List the pickle's instructions without running them; refuse what is not `ADMITTED`."""
    strings: list[str] = []
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        name = opcode.name
        text = str(argument)
        if name not in _OPCODES:
            if name in ("INST", "PERSID", "BINPERSID"):
                _refuse(f"it names '{text}', and only numpy arrays are allowed")
            _refuse(f"it creates objects that are not numpy arrays (instruction {name})")
        if name in _STRINGS:
            strings = [*strings[-1:], text]
        elif name == "GLOBAL":
            module, _, attribute = text.partition(" ")
            if (module, attribute) not in ADMITTED:
                _refuse_global(module, attribute)
        elif name == "STACK_GLOBAL" and len(strings) == 2:
            # The names may also come from the memo; then `find_class` decides.
            known = {part for pair in ADMITTED for part in pair}
            if not known.issuperset(strings):
                _refuse_global(*strings)
        elif name in ("PUT", "BINPUT", "LONG_BINPUT") and int(text) > count:
            _refuse("its memo has numbers beyond its length")


def _plain(value: object, seen: dict[int, object], depth: int) -> object:
    """Return `value` with finished arrays instead of unfinished ones."""
    if isinstance(value, _Array):
        if value.value is None:
            _refuse("an array has no content")
        return value.value
    if not isinstance(value, (dict, list, tuple)):
        if value is None or isinstance(value, (bool, int, float, str, bytes, np.generic)):
            return value
        _refuse(f"it holds a bare {type(value).__name__.strip('_').lower()}")
    if depth > MAX_DEPTH:
        _refuse(f"it is nested deeper than {MAX_DEPTH} levels")
    if id(value) not in seen:
        if isinstance(value, dict):
            made: object = {_key(key): _plain(item, seen, depth + 1) for key, item in value.items()}
        else:
            made = type(value)(_plain(item, seen, depth + 1) for item in value)
        seen[id(value)] = made
    return seen[id(value)]


def _key(key: object) -> str:
    """Return a dictionary's key if it is text."""
    if not isinstance(key, str):
        _refuse(f"a dictionary has a key of type {type(key).__name__}")
    return key


def _refuse(why: str) -> NoReturn:
    raise BadFile(f"{why}.")


def _refuse_global(module: str, name: str) -> NoReturn:
    shown = "".join(c if c.isprintable() else "?" for c in f"{module}.{name}")[:80]
    _refuse(f"it names '{shown}', and only numpy arrays and dtypes are allowed; none of it was run")
