"""Bags made from our own expert's demonstrations, with the writers of `rosbags`."""

import functools
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore

import surgicai_vision.envs as envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.envs import poses

FORMATS = ("bag", "db3", "mcap")
START = 1_700_000_000_000_000_000
"""Time of the first message [ns]."""
TYPES = MappingProxyType(
    {
        "pose": "geometry_msgs/msg/PoseStamped",
        "joints": "sensor_msgs/msg/JointState",
        "jaw": "sensor_msgs/msg/JointState",
        "needle": "geometry_msgs/msg/PoseStamped",
        "label": "std_msgs/msg/String",
    }
)
TOPICS = MappingProxyType(
    {
        "psm1_pose": "/PSM1/measured_cp",
        "psm1_jaw": "/PSM1/jaw/measured_js",
        "psm2_pose": "/PSM2/measured_cp",
        "psm2_jaw": "/PSM2/jaw/measured_js",
        "needle": "/needle/measured_cp",
        "label": "/subtask",
    }
)


@dataclass(frozen=True)
class Motion:
    """The poses in each state of a demonstration, every 20 ms.

    Tips (T, 4, 4) in the arm's base, jaws and joints by arm, needles (T, 4, 4) in world, phases
    (T,).
    """

    tip: dict
    jaw: dict
    joints: dict
    needle: np.ndarray
    phase: np.ndarray

    def __len__(self):
        return len(self.needle)


@functools.cache
def shown(task, seed=0):
    """Return the motion of our expert's episode; cached."""
    env = envs.make(TaskConfig(task))
    result = rollout(env, Expert(env), seed)
    assert result.success
    return measured_motion(env, result.demo)


def measured_motion(env, demo):
    simulation = env.simulation
    tip, jaw, joints = ({arm: [] for arm in names.ARMS} for _ in range(3))
    needles = []
    for state in demo.state:
        env.set_state_vector(state)
        needles.append(poses.square(simulation.needle()))
        for arm in names.ARMS:
            tip[arm].append(poses.square(simulation.tip_in_base(arm)))
            jaw[arm].append(simulation.jaw(arm))
            joints[arm].append(env.data.qpos[env.scene.arms[arm].qpos].copy())
    arrays = ({arm: np.array(rows) for arm, rows in table.items()} for table in (tip, jaw, joints))
    return Motion(*arrays, np.array(needles), np.append(demo.phase, demo.phase[-1]))


def streams(motion, jaw_scale=2.0, labels=True):
    """Return role → (times since the start [ns], values); dVRK's jaw is twice a finger's angle."""
    times = (np.arange(len(motion)) * 20_000_000).astype(np.int64)
    found = {}
    for arm in names.ARMS:
        found[f"{arm}_pose"] = times, motion.tip[arm]
        found[f"{arm}_jaw"] = times, jaw_scale * motion.jaw[arm]
    found["needle"] = times, motion.needle
    if labels:
        changes = np.flatnonzero(np.diff(motion.phase, prepend=-1))
        found["label"] = times[changes], [names.SUBTASKS[motion.phase[index]] for index in changes]
    return found


def write_bag(
    path, form, found, topics=TOPICS, types=TYPES, late=0, frame="PSM_base", stamped=True, packed=""
):
    """Write streams as a bag.

    Args:
        path: of the bag; a ROS 1 bag gets its suffix.
        form: one of `FORMATS`.
        found: role → (times [ns], values).
        topics: role → topic.
        types: kind of role → message type.
        late: largest delay from a message's stamp to its receipt [ns]; delays are random.
        frame: frame_id of the headers.
        stamped: whether the headers have stamps.
        packed: "" for no compression; else zstd, or for ROS 1 "bz2" or "lz4".
    """
    ros1 = form == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    path = path.with_suffix(".bag") if ros1 else path
    rng = np.random.default_rng(0)
    rows = []
    for role, (times, values) in found.items():
        kind = types[role.rsplit("_", 1)[-1]]
        for time, value in zip(times, values, strict=True):
            stamp = START + int(time)
            received = stamp + (int(rng.integers(0, late)) if late else 0)
            message = _message(store, kind, value, stamp if stamped else 0, frame, ros1)
            rows.append((received, topics[role], kind, message))
    storage = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=storage)
    if packed and ros1:
        writer.set_compression(writer.CompressionFormat[packed.upper()])
    elif packed:
        mode = CompressionMode.STORAGE if form == "mcap" else CompressionMode.MESSAGE
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for received, topic, kind, message in sorted(rows, key=lambda row: row[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(connections[topic], received, serialize(message, kind))
    return path


def _message(store, kind, value, stamp, frame, ros1):
    types = store.types
    if kind.startswith("std_msgs"):
        return types[kind](data=value)
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = types["std_msgs/msg/Header"](
        stamp=time, frame_id=frame, **({"seq": 0} if ros1 else {})
    )
    if kind == "sensor_msgs/msg/JointState":
        values = np.atleast_1d(np.asarray(value, dtype=np.float64))
        none = np.zeros(0)
        return types[kind](
            header=header, name=["j"] * len(values), position=values, velocity=none, effort=none
        )
    place, (w, x, y, z) = value[:3, 3].tolist(), _quaternion(value)
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    if kind == "geometry_msgs/msg/TransformStamped":
        shift = types["geometry_msgs/msg/Vector3"](*place)
        transform = types["geometry_msgs/msg/Transform"](translation=shift, rotation=turn)
        return types[kind](header=header, child_frame_id="tip", transform=transform)
    point = types["geometry_msgs/msg/Point"](*place)
    return types[kind](
        header=header, pose=types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    )


def _quaternion(pose):
    """Return w x y z, with either sign, as a recorder may."""
    from surgicai_vision.scene.rotations import matrix_to_quaternion

    quaternion = matrix_to_quaternion(pose[:3, :3])
    return (quaternion * (1.0 if round(pose[0, 3] * 1e7) % 2 else -1.0)).tolist()
