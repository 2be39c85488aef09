"""Untrusted pickles: arrays are read as they were written, all else is refused and never run."""

import collections
import io
import os
import pathlib
import pickle
import pickletools

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from surgicai_vision.core.errors import BadFile
from surgicai_vision.demos.imports import safe_pickle
from surgicai_vision.demos.imports.safe_pickle import unpickle

TREE = [
    {
        "obs": {"observation": np.arange(21, dtype=np.float32), "flag": True},
        "action": np.linspace(-1, 1, 7),
        "done": np.array([0.0], np.float32),
        "info": {"is_success": False, "none": None, "number": 3, "text": "é", "big": 10**20},
        "grid": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "swapped": np.arange(3, dtype=">i4"),
        "empty": np.zeros((0, 7)),
        "bool": np.array([True, False]),
        "scalar": np.float64(2.5),
    }
]


def same(one, two):
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return type(one) is type(two) and len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, np.ndarray):
        return one.dtype == two.dtype and one.shape == two.shape and bool((one == two).all())
    return type(one) is type(two) and one == two


@pytest.mark.parametrize("protocol", [3, 4])
def test_arrays_and_containers_come_back(protocol):
    assert same(unpickle(pickle.dumps(TREE, protocol=protocol), "x"), TREE)


def test_containers_of_protocol_5_come_back_and_its_arrays_are_refused():
    """Protocol 5 writes an array through a function of numpy, which is not allowed."""
    assert unpickle(pickle.dumps(TREE[0]["info"], protocol=5), "x") == TREE[0]["info"]
    with pytest.raises(BadFile, match="_frombuffer"):
        unpickle(pickle.dumps(TREE, protocol=5), "x")


def test_the_original_recording_is_read(shared):
    content = (shared / "surgicai/regrasp_all_episodes_merged.pkl").read_bytes()
    tree = unpickle(content, "x")
    assert same(tree, pickle.loads(content))  # our own copy
    assert len(tree) == 3300


class Call:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def mark(path):
    """Leave a trace; pickles below name it, and it must never run."""
    pathlib.Path(path).touch()


MALICIOUS = {
    "os.system": lambda trace: Call(os.system, f"touch {trace}"),
    "eval": lambda trace: Call(eval, f"__import__('pathlib').Path({trace!r}).touch()"),
    "exec": lambda trace: Call(exec, f"open({trace!r}, 'w')"),
    "open": lambda trace: Call(open, trace, "w"),
    "getattr": lambda trace: Call(getattr, "text", "upper"),
    "our own module": lambda trace: Call(mark, trace),
    "np.save": lambda trace: Call(np.save, trace, 1),
    "np.load": lambda trace: Call(np.load, trace),
    "np.fromfile": lambda trace: Call(np.fromfile, "/etc/hostname"),
    "np.zeros": lambda trace: Call(np.zeros, (10**6,)),
    "ndarray itself": lambda trace: Call(np.ndarray, (10**11,)),
    "object array": lambda trace: np.array([Call(os.system, f"touch {trace}")], dtype=object),
    "plain object array": lambda trace: np.array([None, "x"], dtype=object),
    "structured array": lambda trace: np.zeros(3, [("a", "f4")]),
    "text array": lambda trace: np.array(["a", "b"]),
    "dates": lambda trace: np.array(["2024-01-01"], "M8[D]"),
    "set": lambda trace: {1, 2},
    "path": lambda trace: pathlib.PurePosixPath("/"),
    "ordered": lambda trace: collections.OrderedDict(a=1),
    "class": lambda trace: np.ndarray,
    "dtype": lambda trace: np.dtype("f4"),
    "function": lambda trace: os.system,
    "bytearray": lambda trace: bytearray(3),
}


@pytest.mark.parametrize("protocol", [0, 1, 2, 4, 5])
@pytest.mark.parametrize("name", MALICIOUS)
def test_what_is_not_an_array_is_refused_and_not_run(tmp_path, name, protocol):
    trace = tmp_path / "trace"
    content = pickle.dumps([TREE, MALICIOUS[name](str(trace))], protocol=protocol)
    with pytest.raises(BadFile) as caught:
        unpickle(content, "file.pkl")
    assert not trace.exists()
    assert str(caught.value).startswith("file.pkl is ")
    assert "\n" not in str(caught.value)


def test_the_refusal_names_the_global():
    with pytest.raises(BadFile, match=r"it names '(posix|os)\.system', and only numpy arrays"):
        unpickle(pickle.dumps(Call(os.system, "true")), "x")


def assembled(*parts):
    return b"\x80\x04" + b"".join(parts) + b"."


def text(value):
    return b"\x8c" + bytes([len(value)]) + value.encode()


def test_names_through_the_memo_are_refused_as_well(tmp_path):
    trace = tmp_path / "trace"
    # The two names are memoised, hidden under harmless strings, and fetched again for STACK_GLOBAL.
    content = assembled(
        text("os") + b"\x94" + text("system") + b"\x94" + b"00",
        text("numpy") + text("ndarray") + b"00",
        b"h\x00h\x01\x93" + text(f"touch {trace}") + b"\x85R",
    )
    pickletools.dis(content, out=io.StringIO())
    with pytest.raises(BadFile, match=r"os\.system"):
        unpickle(content, "x")
    assert not trace.exists()


def test_dotted_names_do_not_reach_into_the_stand_ins():
    for name in ("dtype.__class__", "ndarray.__init__.__globals__", "__builtins__"):
        with pytest.raises(BadFile, match="it names 'numpy"):
            unpickle(assembled(text("numpy"), text(name), b"\x93"), "x")


def test_stand_ins_take_no_attributes():
    before = dict(safe_pickle.ADMITTED)
    state = b"}" + text("value") + b"K\x01s"
    for module, name in before:
        with pytest.raises(BadFile):
            unpickle(assembled(text(module), text(name), b"\x93", state, b"b"), "x")
    assert dict(safe_pickle.ADMITTED) == before


def test_bombs_are_refused():
    huge_memo = b"\x80\x03]r\xff\xff\xff\x7f."
    with pytest.raises(BadFile, match="memo"):
        unpickle(huge_memo, "x")
    long_claim = b"\x80\x04\x8e" + (10**15).to_bytes(8, "little") + b"abc."
    with pytest.raises(BadFile):
        unpickle(long_claim, "x")
    deep = b"\x80\x04" + b"]" * 10_000 + b"a" * 9_999 + b"."
    with pytest.raises(BadFile, match="nested deeper"):
        unpickle(deep, "x")
    doubled = assembled(
        b"]\x94",
        b"".join(b"]\x94(" + b"h" + bytes([i]) + b"h" + bytes([i]) + b"e" for i in range(60)),
    )
    with pytest.raises(BadFile, match="nested deeper"):
        unpickle(doubled, "x")
    itself = b"\x80\x04]\x94h\x00a."
    with pytest.raises(BadFile, match="nested deeper"):
        unpickle(itself, "x")


def test_too_large_is_refused(monkeypatch):
    monkeypatch.setattr(safe_pickle, "MAX_BYTES", 100)
    with pytest.raises(BadFile, match="are not read"):
        unpickle(pickle.dumps(TREE), "x")


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x80", b"\x80\x04.", b"PK\x03\x04", b"\x93NUMPY\x01\x00"]
)
def test_what_is_no_pickle_is_a_bad_file(content):
    with pytest.raises(BadFile):
        unpickle(content, "x")


WHOLE = pickle.dumps(TREE, protocol=4)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(cut=st.integers(0, len(WHOLE) - 1))
def test_truncated_is_a_bad_file(cut):
    with pytest.raises(BadFile):
        unpickle(WHOLE[:cut], "x")


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(st.tuples(st.integers(0, len(WHOLE) - 1), st.integers(0, 255)), min_size=1, max_size=8)
)
def test_flipped_bytes_give_data_or_a_bad_file(changes):
    content = bytearray(WHOLE)
    for position, value in changes:
        content[position] = value
    try:
        tree = unpickle(bytes(content), "x")
    except BadFile as error:
        assert "\n" not in str(error)  # noqa: PT017 (either outcome is right)
    else:
        assert isinstance(
            tree, (list, dict, tuple, str, bytes, int, float, np.ndarray, np.generic, type(None))
        )


def test_the_other_readers_of_files_know_no_pickle(root):
    for part in ("demos", "dataset", "core"):
        path = root / "surgicai_vision" / part
        for source in path.rglob("*.py") if path.is_dir() else [path]:
            if source.name != "safe_pickle.py":
                assert "import pickle" not in source.read_text(), source
                assert "allow_pickle=True" not in source.read_text(), source
