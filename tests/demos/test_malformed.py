"""At least two hundred malformed or malicious inputs: each is refused in one line, none is run.

They are made here, by format: pickle, npz and bags (recordings), safetensors (demonstrations),
parquet (datasets), YAML (options). An audit hook catches every process, socket and write of a
reader.
"""

import io
import json
import os
import pickle
import shutil
import struct
import sys
import zipfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bag_writer import FORMATS, write_bag
from cyclopts import Parameter
from fake_demos import render_with_fake_env, write_demos
from fake_env import FakeEnv, FakeExpert
from malformed_bags import databases, good_streams, mcaps, ros1_bags
from read_options import read_options

from surgicai_vision.commands.options import COUNT, FILE_ONLY
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import check_dataset, open_dataset, render_demos
from surgicai_vision.demos.imports import surgicai_pickle
from surgicai_vision.demos.imports.rosbag import reader
from surgicai_vision.demos.imports.rosbag.config import BagConfig
from surgicai_vision.demos.imports.rosbag.resample import resample
from surgicai_vision.demos.imports.rosbag.segments import segments
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.store import demo_bytes, list_demos, read_demo
from surgicai_vision.scene.holes import PAIRS

CONFIG = TaskConfig(max_steps=12)
WATCH = {"on": False, "seen": []}
FORBIDDEN = (
    "os.system",
    "subprocess.",
    "socket.",
    "os.exec",
    "os.fork",
    "os.posix_spawn",
    "ctypes.dlopen",
    "shutil.rm",
)
COUNTS = {"pickle": 0, "npz": 0, "safetensors": 0, "parquet": 0, "yaml": 0, "bag": 0}


def _hook(event, arguments):
    if not WATCH["on"]:
        return
    writes = (
        event == "open"
        and isinstance(arguments[2], int)
        and arguments[2] & (os.O_WRONLY | os.O_RDWR)
    )
    if event.startswith(FORBIDDEN) or writes:
        WATCH["seen"].append((event, str(arguments)[:100]))


sys.addaudithook(_hook)


@contextmanager
def watched():
    WATCH.update(on=True, seen=[])
    try:
        yield
    finally:
        WATCH["on"] = False
    assert WATCH["seen"] == []


def refused(kind, cases, read):
    """Read every case; each must give a one-line error and start nothing."""
    for name, case in cases.items():
        with watched():
            try:
                read(case)
            except InputError as error:
                message = str(error)
            else:
                message = ""
        assert message, f"{kind}: '{name}' was taken"
        assert "\n" not in message, f"{kind}: {name}"
        assert len(message) < 600, f"{kind}: {name}: {message}"
        COUNTS[kind] += 1


class Call:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def transition(**changes):
    row = {
        "obs": {"observation": np.zeros(21)},
        "next_obs": {"observation": np.zeros(21)},
        "action": np.zeros(7),
        "reward": 0.0,
        "done": False,
        "info": {"is_success": False},
    }
    return {**row, **changes}


def evil_calls(trace):
    return {
        "system": Call(os.system, f"touch {trace}"),
        "popen": Call(os.popen, f"touch {trace}"),
        "eval": Call(eval, f"open({trace!r}, 'w')"),
        "exec": Call(exec, f"open({trace!r}, 'w')"),
        "open": Call(open, trace, "w"),
        "import": Call(__import__, "antigravity"),
        "getattr": Call(getattr, os, "system"),
        "remove": Call(os.remove, trace),
        "np.load": Call(np.load, trace),
        "np.zeros": Call(np.zeros, (10**9,)),
    }


def pickles(trace):
    cases = {}
    for protocol in (0, 2, 4, 5):
        for name, call in evil_calls(trace).items():
            row = (
                [transition(reward=call)]
                if name != "getattr"
                else [transition(reward=Call(getattr, "a", "upper"))]
            )
            cases[f"{name} {protocol}"] = pickle.dumps(row, protocol)
    whole = pickle.dumps([transition()] * 3, 4)
    cases.update(
        {f"cut {size}": whole[:size] for size in (0, 1, 2, 10, 50, len(whole) // 2, len(whole) - 1)}
    )
    plain = {
        "number": 3,
        "text": "x",
        "empty": [],
        "numbers": [1, 2],
        "no reward": [{key: value for key, value in transition().items() if key != "reward"}],
        "short action": [transition(action=np.zeros(3))],
        "text action": [transition(action="right")],
        "nan": [transition(reward=float("nan"))],
        "objects": [transition(action=np.array([None], dtype=object))],
        "info": [transition(info=None)],
        "keys": [{1: 2}],
    }
    cases.update({name: pickle.dumps(value, 4) for name, value in plain.items()})
    deep: list = []
    for _ in range(60):
        deep = [deep]
    cases["deep"] = pickle.dumps(deep, 4)
    cases["memo"] = b"\x80\x02]r\xff\xff\xff\x7f."
    cases["laughs"] = b"\x80\x02" + b"]q\x00" + b"(h\x00" * 3 + b"te."
    rng = np.random.default_rng(0)
    cases.update({f"rubbish {index}": b"\x80\x04" + rng.bytes(200) for index in range(5)})
    return cases


def on_disk(folder, cases, ending):
    """Write the cases as files, before anything is watched."""
    folder.mkdir()
    paths = {}
    for number, (name, content) in enumerate(cases.items()):
        paths[name] = folder / f"{number:03d}.{ending}"
        paths[name].write_bytes(content)
    return paths


def test_pickles(tmp_path):
    trace = tmp_path / "trace"
    refused("pickle", on_disk(tmp_path / "files", pickles(str(trace)), "pkl"), surgicai_pickle.read)
    assert not trace.exists()


def npz(**arrays):
    rows = {
        "observation": np.zeros((4, 21)),
        "next_observation": np.zeros((4, 21)),
        "action": np.zeros((4, 7)),
        "reward": np.zeros(4),
        "done": np.zeros(4),
        "is_success": np.zeros(4),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{**rows, **arrays})
    return buffer.getvalue()


def zipped(**entries):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def npy(header):
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def with_entry(name, content):
    buffer = io.BytesIO(npz())
    with zipfile.ZipFile(buffer) as archive:
        entries = {entry: archive.read(entry) for entry in archive.namelist()}
    return zipped(**{**entries, f"{name}.npy": content})


def archives(trace):
    whole = npz()
    call = np.array([Call(os.system, f"touch {trace}")], dtype=object)
    header = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}\n"
    cases = {
        "object action": npz(action=call),
        "object reward": npz(reward=call),
        "text": npz(action=np.array(["a"] * 4)),
        "structured": npz(action=np.zeros((4, 7), dtype=[("a", "f4")])),
        "width": npz(action=np.zeros((4, 6))),
        "rows": npz(action=np.zeros((3, 7))),
        "nan": npz(reward=np.full(4, np.nan)),
        "inf": npz(action=np.full((4, 7), np.inf)),
        "no arrays": zipped(),
        "one array": zipped(**{"action.npy": b""}),
        "paths": zipped(**{"../../action.npy": b"x", "/etc/x.npy": b"x"}),
        "pickle inside": with_entry("action", pickle.dumps(call)),
        "no magic": with_entry("action", b"not an array"),
        "empty": with_entry("action", b""),
        "huge": with_entry("action", npy(header.format("'<f8'", "(1099511627776, 7)"))),
        "negative": with_entry("action", npy(header.format("'<f8'", "(-4, 7)"))),
        "objects": with_entry("action", npy(header.format("'|O'", "(4, 7)"))),
        "code in header": with_entry("action", npy(f"__import__('os').system('touch {trace}')\n")),
        "lambda in header": with_entry("action", npy("(lambda: 1)()\n")),
        "bomb": with_entry("action", npy(header.format("'<f8'", "(4, 7)")) + bytes(70 * 2**20)),
    }
    for size in (4, 30, 100, len(whole) // 3, len(whole) // 2, len(whole) - 30, len(whole) - 1):
        cases[f"cut {size}"] = whole[:size]
    for index, place in enumerate((60, 200, 400)):
        spoilt = bytearray(whole)
        spoilt[place : place + 40] = bytes(40)
        cases[f"spoilt {index}"] = bytes(spoilt)
    return cases


def test_npz(tmp_path):
    trace = tmp_path / "trace"
    refused("npz", on_disk(tmp_path / "files", archives(str(trace)), "npz"), surgicai_pickle.read)
    assert not trace.exists()


def header_of(content):
    size = struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8 : 8 + size]), content[8 + size :]


def tensors(table, body, size=None):
    text = json.dumps(table).encode()
    return struct.pack("<Q", len(text) if size is None else size) + text + body


def demonstrations():
    env = FakeEnv(CONFIG)
    whole = demo_bytes(rollout(env, FakeExpert(env), 1).demo)
    table, body = header_of(whole)

    def tensor(**changes):
        return {**table, "action": {**table["action"], **changes}}

    def values(name, content):
        low, high = table[name]["data_offsets"]
        return tensors(table, body[:low] + content + body[high:])

    count = table["action"]["shape"][0]
    wide = np.full((count, 7), 5.0, np.float32).tobytes()

    def detail(**changes):
        details = {**json.loads(table["__metadata__"]["demo"]), **changes}
        return {**table, "__metadata__": {"demo": json.dumps(details)}}

    cases = {
        "empty": b"",
        "header longer than file": tensors(table, body, 2**40),
        "header of everything": tensors(table, body, 2**63),
        "header of nothing": tensors(table, body, 0),
        "no json": struct.pack("<Q", 4) + b"}{][" + body,
        "a list": tensors([1, 2], body),
        "no metadata": tensors(
            {key: row for key, row in table.items() if key != "__metadata__"}, body
        ),
        "other metadata": tensors({**table, "__metadata__": {"demo": "3"}}, body),
        "metadata no json": tensors({**table, "__metadata__": {"demo": "{"}}, body),
        "metadata nested": tensors({**table, "__metadata__": {"demo": "[" * 100_000}}, body),
        "no action": tensors({key: row for key, row in table.items() if key != "action"}, body),
        "dtype": tensors(tensor(dtype="I64"), body),
        "unknown dtype": tensors(tensor(dtype="PICKLE"), body),
        "shape": tensors(tensor(shape=[1, 7]), body),
        "negative shape": tensors(tensor(shape=[-1, 7]), body),
        "huge shape": tensors(tensor(shape=[2**62, 2**62]), body),
        "offsets beyond": tensors(tensor(data_offsets=[0, 2**40]), body),
        "offsets turned": tensors(tensor(data_offsets=[40, 0]), body),
        "offsets overlap": tensors(tensor(data_offsets=table["state"]["data_offsets"]), body),
        "body gone": tensors(table, b""),
        "body longer": tensors(table, body + bytes(100)),
        "version": tensors(detail(version=99), body),
        "format": tensors(detail(format="other"), body),
        "extra detail": tensors(detail(command="rm -rf /"), body),
        "config of another kind": tensors(detail(config=3), body),
        "unknown task": tensors(detail(config={"task": "stitch"}), body),
        "unknown config key": tensors(detail(config={"task": "grasp", "hook": "os:system"}), body),
        "seed of text": tensors(detail(seed="x"), body),
        "seeds": tensors(detail(seed=[1, 2]), body),
        "demonstrators": tensors(detail(demonstrator=["a"]), body),
        "code of another kind": tensors(detail(code_version={"a": 1}), body),
        "scene of another kind": tensors(detail(scene_hash=5), body),
        "actions out of range": values("action", wide),
        "phases out of range": values("phase", np.full(count, 100, np.int8).tobytes()),
        "not finite": tensors(table, np.full(len(body) // 8 + 1, np.nan).tobytes()[: len(body)]),
        "pickle": pickle.dumps(Call(os.system, "true")),
    }
    cases.update(
        {f"cut {size}": whole[:size] for size in (1, 7, 8, 9, 100, len(whole) // 2, len(whole) - 1)}
    )
    return cases


def test_safetensors(tmp_path):
    refused("safetensors", on_disk(tmp_path / "files", demonstrations(), "safetensors"), read_demo)


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    render_with_fake_env(monkeypatch, CONFIG)
    folder = write_demos(tmp_path / "demos", CONFIG, (1, 2))
    render_demos(folder, tmp_path / "set", size=32, depth=True, context=RunContext(0))
    assert len(list_demos(folder)) == 2
    return tmp_path / "set"


def parquet_bytes(table):
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def images_of(table, content):
    """Return the table's bytes with other content in its first image."""
    key = names.image_key("front")
    rows = table.column(key).to_pylist()
    rows[0] = {"bytes": content, "path": "/etc/passwd"}
    field = table.field(key)
    return parquet_bytes(
        table.set_column(table.schema.get_field_index(key), field, pa.array(rows, field.type))
    )


def data_files(dataset):
    path = dataset / "data/chunk-000/file-000.parquet"
    whole, table = path.read_bytes(), pq.read_table(path)
    footer = struct.unpack("<I", whole[-8:-4])[0]
    cases = {
        "empty": b"",
        "magic alone": b"PAR1",
        "twice the magic": b"PAR1PAR1",
        "no magic at the end": whole[:-4] + b"XXXX",
        "encrypted": whole[:-4] + b"PARE",
        "footer of everything": whole[:-8] + struct.pack("<I", 2**32 - 1) + b"PAR1",
        "footer of nothing": whole[:-8] + struct.pack("<I", 0) + b"PAR1",
        "footer of noughts": whole[: -8 - footer] + bytes(footer) + whole[-8:],
        "footer of ones": whole[: -8 - footer] + b"\xff" * footer + whole[-8:],
        "fewer rows": parquet_bytes(table.slice(0, 3)),
        "more rows": parquet_bytes(pa.concat_tables([table, table])),
        "no columns": parquet_bytes(table.select([])),
        "another table": parquet_bytes(pa.table({"a": [1]})),
        "a pickle": pickle.dumps(Call(os.system, "true")),
        "pages of noughts": whole[:4] + bytes(len(whole) - footer - 12) + whole[-8 - footer :],
    }
    for size in (
        3,
        8,
        100,
        len(whole) // 4,
        len(whole) // 2,
        len(whole) - 9,
        len(whole) - 4,
        len(whole) - 1,
    ):
        cases[f"cut {size}"] = whole[:size]
    for key in (names.ACTION, names.STATE, names.image_key("front"), "index", names.SEED):
        cases[f"no {key}"] = parquet_bytes(table.drop_columns([key]))
    for key in (names.ACTION, "index", names.REWARD):
        text = pa.array(["os.system"] * len(table))
        cases[f"text in {key}"] = parquet_bytes(
            table.set_column(table.schema.get_field_index(key), key, text)
        )
    for key in (names.STATE, names.NEEDLE_POSE):
        numbers = pa.array(np.full(len(table), 0.1, np.float32))
        cases[f"one number in {key}"] = parquet_bytes(
            table.set_column(table.schema.get_field_index(key), key, numbers)
        )
    wrong = {
        "rubbish": b"\x89PNG\r\n\x1a\n" + bytes(40),
        "script": b"#!/bin/sh\ntouch /tmp/x",
        "none": None,
        "void": b"",
    }
    cases.update({f"image: {name}": images_of(table, content) for name, content in wrong.items()})
    # Spoil the second half of a column; no reader uses the statistics before it, or image paths.
    columns = pq.read_metadata(path).row_group(0)
    for index in range(0, columns.num_columns, 2):
        column = columns.column(index)
        if column.path_in_schema.endswith(".path"):
            continue
        start = column.dictionary_page_offset or column.data_page_offset
        stop = start + column.total_compressed_size
        middle = (start + stop) // 2
        rubbish = b"\xa5" * (stop - middle)
        cases[f"rubbish in {column.path_in_schema}"] = whole[:middle] + rubbish + whole[stop:]
    return cases


def test_parquet(tmp_path, dataset):
    sets = {}
    for number, (name, content) in enumerate(data_files(dataset).items()):
        sets[name] = shutil.copytree(dataset, tmp_path / f"set{number}")
        (sets[name] / "data/chunk-000/file-000.parquet").write_bytes(content)

    def read(path):
        open_dataset(path).columns()
        report = check_dataset(path)
        assert not any("\n" in line for line in report.problems)
        if not report.ok:
            raise InputError(report.problems[0])

    refused("parquet", sets, read)
    assert check_dataset(dataset).ok


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Sample:
    episodes: Annotated[int, COUNT] = 5
    scene: Annotated[SceneConfig | None, FILE_ONLY] = None


def yaml_files(trace):
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9)
    )
    texts = {
        "apply": f"!!python/object/apply:os.system ['touch {trace}']",
        "apply as value": f"episodes: !!python/object/apply:os.system ['touch {trace}']",
        "new": "!!python/object/new:os.system ['true']",
        "object": "episodes: !!python/object:subprocess.Popen {args: true}",
        "name": "episodes: !!python/name:os.system",
        "module": "episodes: !!python/module:os",
        "eval": "!!python/object/apply:eval ['1']",
        "tuple": "episodes: !!python/tuple [1, 2]",
        "own tag": "episodes: !run 'true'",
        "ruby": "--- !ruby/object:Gem::Installer\ni: x",
        "laughs": laughs,
        "cycle": "episodes: &a [*a]",
        "cycle of tables": "scene: &a {layout: *a}",
        "deep": "episodes: " + "[" * 3000,
        "deep tables": "{a: " * 2000,
        "list": "- 1\n- 2",
        "text": "hello",
        "number": "3",
        "nothing": "",
        "open": "episodes: [1, 2",
        "tab": "episodes:\n\t- 1",
        "two documents": "episodes: 1\n---\nepisodes: 2",
        "key of numbers": "3: 4",
        "key of lists": "[1, 2]: 3",
        "unknown key": "episods: 3",
        "unknown key below": "scene: {tread: 20}",
        "text for a number": "episodes: three",
        "list for a number": "episodes: [3]",
        "table for a number": "episodes: {a: 1}",
        "truth for a number": "episodes: yes",
        "fraction": "episodes: 3.5",
        "date": "episodes: 2024-01-01",
        "binary": "episodes: !!binary aGVsbG8=",
        "null byte": "episodes: \x00",
        "bad anchor": "episodes: *nothing",
        "merge": "<<: 3",
        "scene of text": "scene: simple",
        "unknown layout": "scene: {layout: real}",
        "thread": "scene: {thread: 1000000}",
    }
    cases = {name: text.encode() for name, text in texts.items()}
    cases["no text"] = b"\xff\xfe\x00episodes"
    cases["latin"] = "episodes: é".encode("latin-1")
    return cases


def test_yaml(tmp_path):
    trace = tmp_path / "trace"
    paths = on_disk(tmp_path / "files", yaml_files(str(trace)), "yaml")
    refused("yaml", paths, lambda path: read_options(Sample, config=Path(path)))
    assert not trace.exists()


def test_bags(tmp_path):
    trace = tmp_path / "trace"
    cases = {
        **{
            f"ros1: {k}": v
            for k, v in on_disk(
                tmp_path / "1", ros1_bags(tmp_path / "a", str(trace)), "bag"
            ).items()
        },
        **{
            f"mcap: {k}": v
            for k, v in on_disk(tmp_path / "2", mcaps(tmp_path / "b"), "mcap").items()
        },
        **{f"db3: {k}": v for k, v in databases(tmp_path / "3", str(trace)).items()},
    }
    sys.modules.pop("rosbags.usertypes", None)

    def read(path):
        recording = resample(reader.read(path, BagConfig().all_topics), BagConfig(), "400006")
        segments(recording, PAIRS["simple"][0], BagConfig(), "grasp")

    for form in FORMATS:
        read(write_bag(tmp_path / f"good_{form}", form, good_streams()))
    refused("bag", cases, read)
    assert not trace.exists()
    assert "rosbags.usertypes" not in sys.modules, "a definition became code"


def test_there_are_two_hundred():
    """Counts what the tests above refused; skipped unless they ran."""
    if not all(COUNTS.values()):
        pytest.skip("the others did not run here")
    assert sum(COUNTS.values()) >= 200, COUNTS
