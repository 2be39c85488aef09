"""Bags of ROS 1 and ROS 2: our own expert's motions are written, imported and compared."""

import itertools

import numpy as np
import pytest
from bag_writer import FORMATS, START, TOPICS, TYPES, shown, streams, write_bag
from scipy.spatial.transform import Rotation

import surgicai_vision.envs as envs
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.demos.dmp.fit import fit_subtask
from surgicai_vision.demos.imports.rosbag import reader, segments
from surgicai_vision.demos.imports.rosbag.config import BagConfig, Frames, Topics
from surgicai_vision.demos.imports.rosbag.importer import import_bags
from surgicai_vision.demos.imports.rosbag.resample import resample
from surgicai_vision.demos.store import read_demo
from surgicai_vision.envs import poses
from surgicai_vision.scene import kinematics
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.rotations import geodesic_angle

WHOLE = BagConfig(drop_pauses=False)
PAIR = PAIRS["simple"][0]


def recorded(path, config=WHOLE):
    return resample(reader.read(path, config.all_topics), config, "400006")


# -- the round trip --------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
def test_what_was_recorded_stands_where_it_stood(tmp_path, form):
    motion = shown("suture")
    bag = write_bag(tmp_path / "trial", form, streams(motion))
    made = import_bags([bag], task=None, out=tmp_path / "demos", config=WHOLE)
    assert [row.task for row in made] == list(names.SUBTASKS)
    assert all((row.skipped, row.succeeded) == ((), 1) for row in made)
    for row in made:
        demo = read_demo(row.paths[0])
        env = envs.make(demo.config)
        phase = names.SUBTASKS.index(row.task)
        first = int(np.argmax(motion.phase == phase))
        assert abs(len(demo) - (motion.phase == phase).sum()) <= 1
        assert (demo.demonstrator, demo.seed, set(demo.phase)) == ("bag", -1, {phase})
        for index, state in enumerate(demo.state):
            env.set_state_vector(state)
            for arm in names.ARMS:
                tip = poses.square(env.simulation.tip_in_base(arm))
                np.testing.assert_allclose(tip, motion.tip[arm][first + index], atol=2e-5)
                assert abs(env.simulation.jaw(arm) - motion.jaw[arm][first + index]) < 0.05
            lying = poses.square(env.simulation.needle())
            np.testing.assert_allclose(lying, motion.needle[first + index], atol=1e-6)


def test_the_three_formats_and_single_files_say_the_same(tmp_path):
    found = streams(shown("grasp"))
    paths = [write_bag(tmp_path / form, form, found) for form in FORMATS]
    paths += [tmp_path / "db3/db3.db3", tmp_path / "mcap/mcap.mcap"]
    first, *others = (reader.read(path, BagConfig().all_topics) for path in paths)
    for other in others:
        assert set(other) == set(first)
        assert all((other[key] == first[key]).all() for key in first)


@pytest.mark.parametrize("form", ["bz2", "lz4", "mcap", "db3"])
def test_packed_bags_say_the_same(tmp_path, form):
    found = streams(shown("grasp"))
    plain = write_bag(tmp_path / "plain", "mcap", found)
    packed = write_bag(
        tmp_path / "packed", "bag" if form in ("bz2", "lz4") else form, found, packed=form
    )
    one, other = (reader.read(path, BagConfig().all_topics) for path in (plain, packed))
    assert all((one[key] == other[key]).all() for key in one)


def test_actions_carry_the_arm_along_the_recorded_path(tmp_path):
    from surgicai_vision.envs.control import StepSize, moved

    motion = shown("pullout")
    bag = write_bag(tmp_path / "trial", "mcap", streams(motion))
    (made,) = import_bags([bag], task="pullout", out=tmp_path / "demos", config=WHOLE)
    demo = read_demo(made.paths[0])
    assert made.clipped == 0
    pose = poses.flat(motion.tip["psm1"][0])
    for row, wanted in zip(demo.action, motion.tip["psm1"][1:], strict=False):
        pose = moved(pose, row.astype(float).tolist(), StepSize.of(made.step))
        np.testing.assert_allclose(poses.square(pose), wanted, atol=1e-4)


def test_an_imported_bag_teaches_a_movement_primitive(tmp_path):
    bag = write_bag(tmp_path / "trial", "bag", streams(shown("place")))
    (made,) = import_bags([bag], task="place", out=tmp_path / "demos")
    fit = fit_subtask("place", [read_demo(path) for path in made.paths])
    assert len(fit.phases) == 1


def test_the_same_import_again_does_nothing_and_another_is_refused(tmp_path):
    bag = write_bag(tmp_path / "trial", "bag", streams(shown("grasp")))
    first = import_bags([bag], task="grasp", out=tmp_path / "demos")
    before = first[0].paths[0].stat().st_mtime_ns
    assert import_bags([bag], task="grasp", out=tmp_path / "demos") == first
    assert first[0].paths[0].stat().st_mtime_ns == before
    with pytest.raises(OutputExists, match="another command"):
        import_bags([bag], task="grasp", out=tmp_path / "demos", config=WHOLE)


def test_several_bags_become_one_folder(tmp_path):
    found = [
        write_bag(tmp_path / f"trial{seed}", "mcap", streams(shown("grasp", seed)))
        for seed in (0, 3)
    ]
    (made,) = import_bags(found, task="grasp", out=tmp_path / "demos")
    assert (made.task, len(made.paths), made.succeeded) == ("grasp", 2, 2)


# -- time ------------------------------------------------------------------------------------------


def swinging(seconds):
    """Return T_base_tip (N, 4, 4) that swings about the start, ±5 mm and ±40° at 1 Hz."""
    phase = 2 * np.pi * np.asarray(seconds)
    motion = np.tile(kinematics.start_in_base("psm2"), (len(phase), 1, 1))
    turn = Rotation.from_rotvec(
        np.radians(40.0) * np.sin(phase)[:, None] * np.array([0.0, 0.6, 0.8])
    )
    motion[:, :3, :3] = turn.as_matrix() @ motion[:, :3, :3]
    motion[:, :3, 3] += 0.005 * np.column_stack([np.sin(phase), np.cos(phase), np.sin(2 * phase)])
    return motion


def irregular(rate, seconds, seed, lost=0.0):
    """Return message times [ns] with ±40 % jitter, some of them lost."""
    rng = np.random.default_rng(seed)
    count = int(rate * seconds)
    times = (np.arange(count) + rng.uniform(-0.4, 0.4, count)) / rate
    times = np.sort(np.abs(times))[rng.random(count) >= lost]
    return (times * 1e9).astype(np.int64)


@pytest.mark.parametrize("lost", [0.0, 0.3])
@pytest.mark.parametrize("late", [0, 8_000_000])
def test_jitter_and_lost_messages_do_not_show_after_resampling(tmp_path, lost, late):
    pose, jaw = irregular(170, 4, 1, lost), irregular(90, 4, 2, lost)
    found = {
        "psm2_pose": (pose, swinging(pose / 1e9)),
        "psm2_jaw": (jaw, 0.4 + 0.2 * np.sin(jaw / 1e9)),
    }
    bag = write_bag(tmp_path / "trial", "mcap", found, late=late)
    recording = recorded(bag)
    assert recording.valid.all()
    np.testing.assert_allclose(np.diff(recording.time), 1 / names.FPS, atol=1e-9)
    seconds = recording.time + max(pose[0], jaw[0]) / 1e9
    wanted = swinging(seconds)
    tip = recording.arms["psm2"].tip
    # A chord over dt misses a swing of 5 mm at 2 Hz by up to A (2 π f dt)² / 8: 0.3 mm over five
    # lost messages.
    assert np.linalg.norm(tip[:, :3, 3] - wanted[:, :3, 3], axis=1).max() < 0.4e-3
    assert np.median(np.linalg.norm(tip[:, :3, 3] - wanted[:, :3, 3], axis=1)) < 0.03e-3
    angles = [geodesic_angle(a[:3, :3], b[:3, :3]) for a, b in zip(tip, wanted, strict=True)]
    assert max(angles) < np.radians(1.0)
    np.testing.assert_allclose(
        recording.arms["psm2"].jaw, 0.5 * (0.4 + 0.2 * np.sin(seconds)), atol=1e-3
    )


def test_a_commanded_jaw_holds_until_the_next_command(tmp_path):
    """The challenge publishes no measured jaw, and commands only when they change."""
    motion = shown("grasp")
    found = streams(motion)
    times = found["psm2_pose"][0]
    middle = times[len(times) // 2]
    found["psm2_jaw"] = np.array([times[3], middle]), [0.5, 0.1]
    topics = {**TOPICS, "psm2_jaw": "/CRTK/psm2/jaw/servo_jp"}
    config = BagConfig(jaw_scale=1.0, topics=Topics(psm2_jaw="/CRTK/psm2/jaw/servo_jp"))
    recording = recorded(write_bag(tmp_path / "trial", "mcap", found, topics), config)
    assert len(recording) == len(motion)
    assert recording.valid.all()
    wanted = np.where(times < middle, 0.5, 0.1)
    np.testing.assert_array_equal(recording.arms["psm2"].jaw, wanted)


def test_speed_stretches_the_motion(tmp_path):
    bag = write_bag(tmp_path / "trial", "mcap", streams(shown("grasp")))
    normal, slow = recorded(bag), recorded(bag, BagConfig(speed=0.5))
    assert abs(len(slow) - 2 * len(normal)) <= 1
    np.testing.assert_allclose(slow.arms["psm2"].tip[::2], normal.arms["psm2"].tip, atol=1e-9)


def test_without_stamps_the_time_of_reception_counts(tmp_path):
    times = irregular(200, 2, 3)
    bag = write_bag(
        tmp_path / "trial", "bag", {"psm2_pose": (times, swinging(times / 1e9))}, stamped=False
    )
    tip = recorded(bag).arms["psm2"].tip
    wanted = swinging(recorded(bag).time + times[0] / 1e9)
    assert np.linalg.norm(tip[:, :3, 3] - wanted[:, :3, 3], axis=1).max() < 0.1e-3
    with pytest.raises(InputError, match="no stamps"):
        recorded(bag, BagConfig(clock="stamp"))


def test_labels_without_stamps_agree_with_poses_that_have_them(tmp_path):
    """A constant delay between stamp and reception does not shift the labels against the poses."""
    motion = shown("suture")
    found = streams(motion)
    bag = write_bag(tmp_path / "trial", "mcap", found)
    arrays = reader.read(bag, WHOLE.all_topics)
    for key in arrays:
        if key.endswith(".time"):
            arrays[key] = arrays[key] + 70_000_000
    delayed = resample(arrays, WHOLE, "400006")
    assert (delayed.label == recorded(bag).label).all()


def test_messages_out_of_order_and_repeated_are_put_right(tmp_path):
    times = irregular(200, 2, 4)
    bag = write_bag(tmp_path / "trial", "mcap", {"psm2_pose": (times, swinging(times / 1e9))})
    arrays = reader.read(bag, WHOLE.all_topics)
    order = np.random.default_rng(0).permutation(np.append(np.arange(len(times)), [5, 5, 9]))
    mixed = {
        key: array[order] if array.ndim and key != "topics" else array
        for key, array in arrays.items()
    }
    one, other = (resample(some, WHOLE, "400006").arms["psm2"].tip for some in (arrays, mixed))
    np.testing.assert_array_equal(one, other)


def test_a_gap_costs_the_part_it_lies_in(tmp_path):
    motion = shown("suture")
    found = streams(motion)
    times, tips = found["psm2_pose"]
    silent = (times > 2_400_000_000) & (times < 2_900_000_000)  # while placing
    found["psm2_pose"] = times[~silent], tips[~silent]
    bag = write_bag(tmp_path / "trial", "mcap", found)
    made = import_bags([bag], task=None, out=tmp_path / "demos")
    assert [row.task for row in made] == ["grasp", "insert", "handoff", "pullout"]
    with pytest.raises(InputError, match=r"place: a topic is silent for over 0\.2 s"):
        import_bags([bag], task="place", out=tmp_path / "other")
    patient = import_bags(
        [bag], task="place", out=tmp_path / "other", config=BagConfig(max_gap=1.0)
    )
    assert len(patient[0].paths) == 1


def test_pauses_are_left_out_and_slow_motion_is_not():
    count = 300
    tip = np.tile(kinematics.start_in_base("psm2"), (count, 1, 1))
    way = np.concatenate(
        [np.linspace(0, 0.01, 100), np.full(100, 0.01), 0.01 + np.linspace(0, 0.001, 100)]
    )
    tip[:, 0, 3] += way + 2e-6 * np.random.default_rng(0).normal(size=count)
    kept = segments.moving(tip, np.zeros(count))
    rested = (kept > 110) & (kept < 190)
    assert not rested.any()
    assert {0, count - 1} <= set(kept)
    assert len(kept) >= 200 - 2 * segments.WINDOW
    jaw = np.concatenate([np.zeros(120), np.linspace(0, 0.5, 50), np.full(130, 0.5)])
    assert set(range(125, 165)) <= set(segments.moving(tip, jaw)), "a closing jaw is no pause"


def test_yaw_past_half_a_turn_is_no_jump(tmp_path):
    """Half of SurgicAI's insertions turn the long way round; with quaternions none does."""
    times = (np.arange(100) * 20_000_000).astype(np.int64)
    motion = np.tile(kinematics.start_in_base("psm2"), (100, 1, 1))
    yaw = np.arctan2(motion[0, 1, 0], motion[0, 0, 0])
    turn = Rotation.from_euler("z", (np.linspace(np.pi - 0.3, np.pi + 0.3, 100) - yaw)[:, None])
    motion[:, :3, :3] = turn.as_matrix() @ motion[:, :3, :3]
    found = {"psm2_pose": (times, motion), "needle": (times, motion)}
    tip = recorded(write_bag(tmp_path / "trial", "bag", found)).arms["psm2"].tip
    turns = [geodesic_angle(a[:3, :3], b[:3, :3]) for a, b in itertools.pairwise(tip)]
    np.testing.assert_allclose(turns, 0.6 / 99, rtol=1e-3)


# -- frames and units ------------------------------------------------------------------------------


def seven(pose):
    return (
        *pose[:3, 3].tolist(),
        *Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True).tolist(),
    )


def some_pose(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.2, 0.2, 3)
    return pose


def test_frames_and_units_are_converted(tmp_path):
    motion = shown("place")
    frame, tool, world, mark = (some_pose(seed) for seed in range(4))
    found = streams(motion)
    tips = np.linalg.inv(frame) @ motion.tip["psm2"] @ tool
    tips[:, :3, 3] *= 1000.0
    lying = np.linalg.inv(world) @ motion.needle @ mark
    lying[:, :3, 3] *= 10.0
    found = {"psm2_pose": (found["psm2_pose"][0], tips), "needle": (found["needle"][0], lying)}
    config = BagConfig(
        frames=Frames(
            psm2=seven(frame), tip=seven(tool), needle=seven(world), needle_offset=seven(mark)
        ),
        length_scale=0.001,
        needle_scale=0.1,
    )
    recording = recorded(write_bag(tmp_path / "trial", "mcap", found, frame="ECM"), config)
    np.testing.assert_allclose(recording.arms["psm2"].tip, motion.tip["psm2"], atol=1e-9)
    np.testing.assert_allclose(recording.needle, motion.needle, atol=1e-9)


def test_poses_relative_to_the_endoscope_are_refused(tmp_path):
    bag = write_bag(tmp_path / "trial", "mcap", streams(shown("grasp")), frame="ECM")
    with pytest.raises(InputError, match=r"is in frame 'ecm'.*local/measured_cp"):
        import_bags([bag], task="grasp", out=tmp_path / "demos")


def test_joints_serve_where_there_is_no_pose(tmp_path):
    motion = shown("grasp")
    found = streams(motion)
    times = found.pop("psm2_pose")[0]
    found["psm2_joints"] = times, motion.joints["psm2"]
    topics = {**TOPICS, "psm2_joints": "/PSM2/measured_js"}
    recording = recorded(write_bag(tmp_path / "trial", "bag", found, topics))
    np.testing.assert_allclose(recording.arms["psm2"].tip, motion.tip["psm2"], atol=2e-6)


def test_transforms_and_whole_numbers_are_read_as_well(tmp_path):
    motion = shown("suture")
    found = streams(motion)
    times, labels = found["label"]
    found["label"] = times, [names.SUBTASKS.index(label) for label in labels]
    types = {**TYPES, "pose": "geometry_msgs/msg/TransformStamped", "label": "std_msgs/msg/Int32"}
    plain, other = (
        write_bag(tmp_path / name, "mcap", *rest)
        for name, *rest in (("plain", streams(motion)), ("other", found, TOPICS, types))
    )
    one, two = recorded(plain), recorded(other)
    np.testing.assert_array_equal(one.arms["psm1"].tip, two.arms["psm1"].tip)
    assert segments.segments(one, PAIR, WHOLE, None) == segments.segments(two, PAIR, WHOLE, None)


AMBF = """\
Header header  # AMBF's state of a body, of a version of its own
uint32 sim_step
string name
float32 mass
geometry_msgs/Pose pose
float32[] joint_positions
================================================================================
MSG: std_msgs/Header
uint32 seq
"""


def test_states_of_ambf_are_read_by_the_definition_in_the_bag(tmp_path):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    motion = shown("place")
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(AMBF.split("\n===")[0], "ambf_msgs/msg/RigidBodyState"))
    types = store.types
    with Writer(tmp_path / "trial.bag") as writer:
        topics = ("/ambf/env/Needle/State", "/ambf/env/psm2/baselink/State")
        needle, arm = (
            writer.add_connection(topic, "ambf_msgs/msg/RigidBodyState", typestore=store)
            for topic in topics
        )
        for index, lying in enumerate(motion.needle):
            time = START + index * 20_000_000
            stamp = types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="world", seq=0)
            x, y, z, *turn = seven(lying)
            point = types["geometry_msgs/msg/Point"](10 * x, 10 * y, 10 * z)
            w, i, j, k = turn
            pose = types["geometry_msgs/msg/Pose"](
                point, types["geometry_msgs/msg/Quaternion"](i, j, k, w)
            )
            joints = np.append(motion.joints["psm2"][index], [0.1, 0.1]).astype(np.float32)
            joints[2] *= 10
            message = types["ambf_msgs/msg/RigidBodyState"](
                header, index, "body", 0.1, pose, joints
            )
            for connection in (needle, arm):
                writer.write(connection, time, store.serialize_ros1(message, connection.msgtype))
    state = "/ambf/env/psm2/baselink/State"
    config = BagConfig(
        "ambf", Topics(psm2_joints=state, psm2_jaw=state, needle="/ambf/env/Needle/State")
    )
    recording = recorded(tmp_path / "trial.bag", config)
    np.testing.assert_allclose(recording.needle, motion.needle, atol=1e-9)
    np.testing.assert_allclose(recording.arms["psm2"].tip, motion.tip["psm2"], atol=1e-6)
    np.testing.assert_allclose(recording.arms["psm2"].jaw, 0.1, atol=1e-6)
