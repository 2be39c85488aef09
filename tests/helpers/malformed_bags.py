"""Malformed and malicious bags for `test_malformed`."""

import bz2
import contextlib
import os
import pickle
import re
import shutil
import sqlite3
import struct

import numpy as np
from bag_writer import write_bag
from rosbags.rosbag1 import Writer as RosWriter


class Run:
    """A pickle that would run a command."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def good_streams():
    """Return the streams of a small valid bag."""
    times, found = np.arange(20) * 20_000_000, np.tile(np.eye(4), (20, 1, 1))
    return {"psm1_pose": (times, found), "needle": (times, found), "label": (times, ["grasp"] * 20)}


def message(sec=1, place=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0, 1.0), frame=b"base", length=None):
    """Return a PoseStamped as ROS 1 writes it."""
    count = len(frame) if length is None else length
    return struct.pack("<IIII", 0, sec, 0, count) + frame + struct.pack("<7d", *place, *turn)


def ros1_bag(
    path,
    rows,
    kind="geometry_msgs/msg/PoseStamped",
    text="",
    topic="/PSM1/measured_cp",
    packed=False,
):
    """Return a bag of raw messages under any type name and definition."""
    writer = RosWriter(path)
    if packed:
        writer.set_compression(RosWriter.CompressionFormat.BZ2)
    with writer:
        connection = writer.add_connection(topic, kind, msgdef=text, md5sum="0" * 32)
        for index, row in enumerate(rows):
            writer.write(connection, 10**9 + index, row)
    return path.read_bytes()


def ros1_bomb(path):
    """Return a bag whose only chunk unpacks to 256 MB."""
    whole = ros1_bag(path, [message()], packed=True)
    start = whole.index(b"BZh")
    size = struct.unpack("<I", whole[start - 4 : start])[0]
    bomb = bz2.compress(bytes(2**28))
    grown = whole[: start - 4] + struct.pack("<I", len(bomb)) + bomb + whole[start + size :]
    place = grown.index(b"index_pos=") + len(b"index_pos=")
    index = struct.unpack("<Q", grown[place : place + 8])[0] + len(bomb) - size
    return grown[:place] + struct.pack("<Q", index) + grown[place + 8 :]


def evil_definitions(trace):
    """Return bad definitions; a reader that compiles them would run some."""
    call = f"__import__('os').system('touch {trace}')"
    return {
        "call as a type": f"{call} x",
        "call as a name": f"float64 {call}",
        "call as a default": f"float64 x {call}",
        "call as a constant": f"string x={call}",
        "quotes": f'float64 x"""\n{call}\n"""',
        "newline and code": f"float64 x\n\nimport os\n{call}\n",
        "lambda": f"float64[{call}] x",
        "dunder": "float64 __class__\nfloat64 __init__",
        "unknown type": "evil_msgs/Evil x",
        "itself": "ambf_msgs/RigidBodyState x",
        "array of messages": "geometry_msgs/Pose[] x",
        "fixed array": "float64[999999999] x",
        "long": "float64 x\n" * 100_000,
        "wide": "\n".join(f"geometry_msgs/Pose x{index}" for index in range(100)),
        "binary": "\x00\x01\x02",
        "no name": "float64",
    }


def ros1_bags(folder, trace):
    folder.mkdir()
    whole = write_bag(folder / "good", "bag", good_streams()).read_bytes()
    nan, inf = float("nan"), float("inf")
    rows = {
        "nan": message(place=(nan, 0.0, 0.0)),
        "inf": message(place=(0.0, inf, 0.0)),
        "nan turn": message(turn=(nan, 0.0, 0.0, 1.0)),
        "no turn": message(turn=(0.0, 0.0, 0.0, 0.0)),
        "long turn": message(turn=(0.0, 0.0, 0.0, 7.0)),
        "text beyond": message(length=2**32 - 1),
        "text short": message(length=1),
        "no text": message(frame=b"\xff\xfe"),
        "another frame": message(frame=b"\x1b[2Jx\n"),
        "empty message": b"",
        "cut message": message()[:-9],
        "more than a message": message() + b"x",
        "huge message": message() + bytes(2**21),
    }
    cases = {name: ros1_bag(folder / f"{name}.bag", [message(), row]) for name, row in rows.items()}
    kinds = (
        "std_msgs/msg/String",
        "sensor_msgs/msg/Image",
        "evil_msgs/msg/Evil",
        "__import__('os')/msg/x",
        "x\ny/msg/z",
    )
    for index, kind in enumerate(kinds):
        cases[f"type {kind!r}"] = ros1_bag(folder / f"type{index}.bag", [message()], kind)
    for index, (name, text) in enumerate(evil_definitions(trace).items()):
        path = folder / f"evil{index}.bag"
        cases[name] = ros1_bag(
            path, [message()], "ambf_msgs/msg/RigidBodyState", text, "/needle/measured_cp"
        )
    cases["topic"] = ros1_bag(folder / "topic.bag", [message()], topic="/\x1b[2J\n" + "x" * 5000)
    cases["stamps years apart"] = ros1_bag(folder / "stamps.bag", [message(1), message(2**31)])
    cases["one message"] = ros1_bag(folder / "one.bag", [message()])
    cases["none"] = ros1_bag(folder / "none.bag", [])
    cases["bomb"] = ros1_bomb(folder / "bomb.bag")
    for size in (0, 1, 5, 13, 20, 100, 4096, len(whole) // 2, len(whole) - 200, len(whole) - 1):
        cases[f"cut {size}"] = whole[:size]
    cases["version"] = whole.replace(b"#ROSBAG V2.0", b"#ROSBAG V1.2")
    cases["compression"] = whole.replace(b"compression=none", b"compression=eval")
    cases["not packed"] = whole.replace(b"compression=none", b"compression=bz2\x00")
    for field in (b"index_pos=", b"conn_count=", b"chunk_count=", b"chunk_pos="):
        place = whole.index(field) + len(field)
        for value in (b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff"):
            cases[f"{field.decode()}{value.hex()}"] = whole[:place] + value + whole[place + 4 :]
    rng = np.random.default_rng(0)
    cases.update({f"rubbish {index}": b"#ROSBAG V2.0\n" + rng.bytes(5000) for index in range(5)})
    cases["pickle"] = pickle.dumps(Run(f"touch {trace}"))
    return cases


def mcaps(folder):
    folder.mkdir()
    whole = (write_bag(folder / "good", "mcap", good_streams()) / "good.mcap").read_bytes()
    sizes = (0, 7, 8, 30, 100, len(whole) // 2, len(whole) - 37, len(whole) - 1)
    cases = {f"cut {size}": whole[:size] for size in sizes}
    for index, match in enumerate(re.finditer(b"PSM_base", whole)):
        length, place = match.start() - 4, match.start()
        if index % 7 == 0 and place < len(whole) // 2:
            cases[f"noughts {index}"] = whole[:length] + bytes(4) + whole[place:]
            cases[f"ones {index}"] = whole[:length] + b"\xff" * 4 + whole[place:]
            cases[f"rubbish {index}"] = whole[: length - 12] + b"\xa5" * 60 + whole[length + 48 :]
    cases["profile"] = whole.replace(b"ros2", b"ros9", 1)
    cases["type"] = whole.replace(
        b"geometry_msgs/msg/PoseStamped", b"geometry_msgs/msg/PoseStampeX"
    )
    cases["summary"] = whole[:-28] + struct.pack("<Q", 2**63) + whole[-20:]
    cases["footer alone"] = whole[:8] + whole[-37:]
    return cases


def databases(folder, trace):
    """Write ROS 2 folders with unusual or malicious databases and descriptions."""
    folder.mkdir()
    good = write_bag(folder / "good", "db3", good_streams())
    changes = {
        "view": ["ALTER TABLE messages RENAME TO m", "CREATE VIEW messages AS SELECT * FROM m"],
        "endless view": [
            "DROP TABLE messages",
            "CREATE VIEW messages AS WITH RECURSIVE "
            "c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c) "
            "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM c",
        ],
        "trigger": ["CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END"],
        "virtual table": ["CREATE VIRTUAL TABLE v USING fts5(a)"],
        "generated": [
            "CREATE TABLE g (a INTEGER, b BLOB GENERATED ALWAYS AS (zeroblob(1000000000)))"
        ],
        "no messages": ["DELETE FROM messages"],
        "no topics": ["DROP TABLE topics"],
        "text for bytes": ["UPDATE messages SET data = 'hello'"],
        "numbers for bytes": ["UPDATE messages SET data = 7"],
        "short bytes": ["UPDATE messages SET data = x'0001'"],
        "zero bytes": ["UPDATE messages SET data = zeroblob(50000000)"],
        "types": ["UPDATE topics SET type = 'os/msg/system'"],
        "qos": [
            "UPDATE topics SET offered_qos_profiles = '!!python/object/apply:os.system [true]'"
        ],
    }
    cases = {}
    for name, statements in changes.items():
        cases[name] = shutil.copytree(good, folder / name.replace(" ", "_"))
        (file,) = cases[name].glob("*.db3")
        with contextlib.closing(sqlite3.connect(file)) as connection, connection:
            for statement in statements:
                connection.execute(statement)
    text = (good / "metadata.yaml").read_text()
    tables = {
        "object": f"!!python/object/apply:os.system ['touch {trace}']",
        "list": "- 1",
        "nothing": "",
        "deep": text + "x: " + "[" * 100_000,
        "no topics": "rosbag2_bagfile_information: {version: 9}",
        "other files": text.replace("good.db3", "../../../../etc/passwd"),
        "other storage": text.replace("sqlite3", "os.system"),
        "future": text.replace("version: 9", "version: 99"),
        "packed": text.replace(
            "compression_mode: ''", "compression_mode: FILE\n  compression_format: zstd"
        ),
        "other packing": text.replace("compression_mode: ''", "compression_mode: MESSAGE"),
        "no cdr": text.replace("serialization_format: cdr", "serialization_format: pickle"),
        "binary": "\x00\x01",
    }
    for name, table in tables.items():
        assert table != text, name
        cases[f"yaml {name}"] = shutil.copytree(good, folder / f"yaml_{name.replace(' ', '_')}")
        (cases[f"yaml {name}"] / "metadata.yaml").write_text(table)
    for size in (0, 10, 100, 5000):
        cases[f"cut {size}"] = shutil.copytree(good, folder / f"cut{size}")
        (file,) = cases[f"cut {size}"].glob("*.db3")
        file.write_bytes(file.read_bytes()[:size])
    return cases
