"""CRTK without ROS: states, trajectories, frames, and how an arm handles its commands."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.envs import absolute, poses
from surgicai_vision.robot import arm as arms
from surgicai_vision.robot import frames, topics
from surgicai_vision.robot.arm import ArmState, Endoscope, Psm
from surgicai_vision.robot.messages import Header, JointState, PoseStamped, StringStamped
from surgicai_vision.robot.operating_state import COMMANDS, FAULT, STATES, OperatingStates
from surgicai_vision.robot.trajectory import Trajectory
from surgicai_vision.scene import kinematics
from surgicai_vision.scene.cameras import ENDOSCOPE

NOW = 1_795_000_000_000_000_000
BASE = poses.flat(kinematics.base_in_world(names.PSM2))
START = kinematics.inverse_flat(poses.flat(kinematics.start_in_base(names.PSM2)))
STILL = (0.0,) * 6
STATE = ArmState(START, STILL, 1.6, 0.0, START, 1.6)


def psm():
    return Psm("PSM2", BASE, kinematics.DEFAULT)


def joints(values, names=arms.JOINT_NAMES, stamp=0):
    return JointState(Header(stamp), names, tuple(values))


def say(text):
    return StringStamped(Header(), text)


def moved(state, target):
    """Return the state of an arm that has followed its target at once."""
    if target is None:
        return state
    return dataclasses.replace(
        state,
        joints=target.joints,
        setpoint=target.joints,
        jaw=target.jaw,
        jaw_setpoint=target.jaw,
    )


# -- operating states ------------------------------------------------------------------------------


@given(st.lists(st.sampled_from(COMMANDS), max_size=20))
def test_an_arm_moves_only_when_enabled_and_homed(commands):
    machine = OperatingStates()
    for command in commands:
        before = (machine.state, machine.is_homed)
        try:
            machine.command(command)
        except InputError:
            assert (machine.state, machine.is_homed) == before
        assert machine.state in STATES
        assert machine.may_move == (machine.state == "ENABLED" and machine.is_homed)


@pytest.mark.parametrize("state", STATES)
def test_a_disabled_or_faulted_arm_must_be_enabled_anew(state):
    machine = OperatingStates(state)
    machine.command("fault")
    for command in ("enable", "pause", "resume"):
        with pytest.raises(InputError, match="not possible in FAULT"):
            machine.command(command)
    machine.command("clear_fault")
    assert machine.state == "DISABLED"
    machine.command(" Enable ")
    assert machine.may_move


def test_an_unknown_state_command_lists_the_known_ones():
    with pytest.raises(UnknownName, match="clear_fault"):
        OperatingStates().command("enabel")


# -- trajectories ----------------------------------------------------------------------------------

vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


@given(vectors, vectors)
def test_a_trajectory_keeps_its_speeds_and_ends_at_rest(start, goal):
    speeds = (0.5, 0.05, 1.75)
    way = Trajectory(start, goal, speeds, 7.0)
    times = 7.0 + np.append(np.linspace(0.0, way.duration, 41)[:-1], way.duration + 1e-9)
    samples = [way.sample(time) for time in times]
    positions = np.array([sample.position for sample in samples])
    velocities = np.array([sample.velocity for sample in samples])
    assert np.allclose(positions[0], start)
    assert samples[-1].is_end
    assert samples[-1].position == tuple(goal)
    assert np.allclose(velocities[[0, -1]], 0.0)
    assert (np.abs(velocities) <= np.array(speeds) * (1 + 1e-9)).all()
    steps = np.diff(positions, axis=0) * np.sign(np.subtract(goal, start))
    assert (steps >= -1e-12).all()  # no joint turns back
    assert way.sample(times[-1] + 100.0).position == tuple(goal)
    assert np.allclose(way.sample(0.0).position, start, atol=1e-8)


@given(vectors, vectors, st.floats(0.05, 0.95))
def test_the_velocity_is_the_positions_derivative(start, goal, share):
    way = Trajectory(start, goal, (1.0, 1.0, 1.0), 0.0)
    step = 1e-6 * way.duration
    at = share * way.duration
    before, after = (np.array(way.sample(at + sign * step).position) for sign in (-1, 1))
    if way.duration > 1e-3:
        assert np.allclose((after - before) / (2 * step), way.sample(at).velocity, atol=1e-4)


def test_the_fastest_joint_reaches_its_speed():
    way = Trajectory((0.0, 0.0), (1.0, 0.1), (0.5, 0.5), 0.0)
    assert way.sample(way.duration / 2).velocity[0] == pytest.approx(0.5)


def test_vectors_of_different_length_are_refused():
    with pytest.raises(InputError, match="same number"):
        Trajectory((0.0,), (1.0, 2.0), (1.0,), 0.0)


# -- frames ----------------------------------------------------------------------------------------


def test_the_view_is_what_a_surgeon_sees():
    """X left, y up, z away (dvrk_simulator_base/cartesian_frames.py)."""
    from_world = poses.invert(absolute.T_WORLD_VIEW)
    origin = poses.transform(from_world, ENDOSCOPE)
    assert np.allclose(origin, 0.0)
    needle_home = (0.0, 0.05, 0.075)
    assert poses.transform(from_world, needle_home)[2] > 0.05  # in front of the endoscope
    higher = poses.transform(from_world, (0.0, 0.05, 0.085))
    assert higher[1] > poses.transform(from_world, needle_home)[1]
    # PSM1 is the surgeon's left arm (`names.TASK_TEXTS`), hence at greater x.
    sides = [
        poses.transform(from_world, tuple(kinematics.base_in_world(arm)[:3, 3]))
        for arm in names.ARMS
    ]
    assert sides[0][0] > sides[1][0]


def test_optical_frame_and_view_differ_by_the_contracts_rotation():
    turn = np.array(poses.relative(frames.T_WORLD_ECM, absolute.T_WORLD_VIEW)[3:]).reshape(3, 3)
    assert np.allclose(turn, [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize("frame", ["", "ECM_view", "world", "PSM2_base"])
def test_a_pose_survives_the_way_into_any_frame_and_back(frame):
    own = psm().frames
    pose = kinematics.forward_flat(START)
    message = frames.write_pose(own.from_base(pose, frame), 5, frame)
    assert message.header == Header(5, frame)
    assert np.allclose(own.to_base(message), pose, atol=1e-12)
    assert np.linalg.norm(message.quaternion) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"position": (0.0, math.nan, 0.0)}, "finite"),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "unit quaternion"),
        ({"quaternion": (0.0, 0.0, 0.0, math.inf)}, "finite"),
        ({"header": Header(0, "map")}, "Unknown frame"),
    ],
)
def test_a_pose_that_cannot_be_used_is_refused(changes, problem):
    good = PoseStamped(Header(0, "world"), (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(InputError, match=problem):
        psm().receive("servo_cp", dataclasses.replace(good, **changes), "a", NOW)


def test_the_twist_is_the_poses_derivative():
    velocity = (0.3, -0.2, 0.01, 1.0, -0.5, 0.7)
    linear, angular = frames.twist(START, velocity, kinematics.DEFAULT)
    step = 1e-4
    after = kinematics.forward_flat(tuple(np.add(START, step * np.array(velocity))))
    before = kinematics.forward_flat(START)
    assert np.allclose(np.subtract(after[:3], before[:3]) / step, linear, atol=1e-4)
    turn = np.reshape(after[3:], (3, 3)) @ np.reshape(before[3:], (3, 3)).T
    skew = (turn - turn.T) / (2 * step)
    assert np.allclose([skew[2, 1], skew[0, 2], skew[1, 0]], angular, atol=1e-3)


# -- how an arm handles commands -------------------------------------------------------------------


def test_a_servo_is_superseded_and_moves_keep_their_order():
    arm = psm()
    for shift in (0.01, 0.02, 0.03):
        arm.receive("servo_jp", joints(np.add(START, [shift, 0, 0, 0, 0, 0])), "a", NOW)
    assert arm.advance(0.0, STATE).joints[0] == pytest.approx(START[0] + 0.03)
    assert arm.advance(0.02, STATE) is None
    for shift in (0.1, 0.2):
        arm.receive("move_jp", joints(np.add(START, [shift, 0, 0, 0, 0, 0])), "a", NOW)
    state = STATE
    for step in range(400):
        state = moved(state, arm.advance(0.02 * step, state))
    assert not arm.is_busy
    assert state.joints[0] == pytest.approx(START[0] + 0.2)


def test_moves_overflow_with_an_error_and_nothing_is_lost():
    arm = psm()
    for _ in range(arms.QUEUE):
        arm.receive("move_jp", joints(START), "a", NOW)
    with pytest.raises(InputError, match="dropped"):
        arm.receive("move_jp", joints(START), "a", NOW)
    arm.receive("servo_jp", joints(START), "a", NOW)  # a set point is always accepted


def test_a_stop_is_obeyed_however_many_commands_are_waiting():
    arm = psm()
    for _ in range(arms.QUEUE):
        arm.receive("move_jp", joints(np.add(START, [0.1, 0, 0, 0, 0, 0])), "a", NOW)
    arm.receive("state_command", say("fault"), "b", NOW)
    arm.advance(0.0, STATE)
    assert arm.operating.state == FAULT and not arm.is_busy
    assert any("rejected move_jp" in note.text for note in arm.notes)
    for _ in range(arms.QUEUE):
        arm.receive("state_command", say("fault"), "b", NOW)
    with pytest.raises(InputError, match="dropped"):
        arm.receive("state_command", say("fault"), "b", NOW)


@pytest.mark.parametrize("commands", [("enable",), ("pause", "resume"), ("disable", "enable")])
def test_a_motion_after_an_arm_is_enabled_again_is_obeyed(commands):
    arm = psm()
    for command in commands:
        arm.receive("state_command", say(command), "a", NOW)
    arm.receive("move_jp", joints(np.add(START, [0.1, 0, 0, 0, 0, 0])), "a", NOW)
    arm.advance(0.0, STATE)
    assert arm.is_busy


def test_joints_may_come_in_any_order_or_without_names():
    arm = psm()
    for given_names, order in [
        (arms.JOINT_NAMES[::-1], slice(None, None, -1)),
        ((), slice(None)),
        (tuple("012345"), slice(None)),
    ]:
        arm.receive("servo_jp", joints(START[order], given_names), "a", NOW)
        assert arm.advance(0.0, STATE).joints == START


@pytest.mark.parametrize(
    ("channel", "values"),
    [
        ("servo_jp", (0.0,) * 5),
        ("servo_jp", (math.nan, *START[1:])),
        ("move_jp", (10.0, *START[1:])),
        ("jaw/servo_jp", (0.1, 0.2)),
        ("jaw/servo_jp", (math.inf,)),
        ("jaw/move_jp", (9.0,)),
    ],
)
def test_joints_that_cannot_be_used_are_refused(channel, values):
    arm = psm()
    with pytest.raises(InputError):
        arm.receive(channel, joints(values, ()), "a", NOW)
    assert arm.advance(0.0, STATE) is None


def test_a_cartesian_set_point_in_any_frame_is_the_same():
    pose = kinematics.forward_flat(tuple(np.add(START, [0.01, 0.02, 0.005, 0, 0.1, 0])))
    told = []
    for frame in ("", "ECM_view", "world", "PSM2_base"):
        arm = psm()
        message = frames.write_pose(arm.frames.from_base(pose, frame), 0, frame)
        arm.receive("servo_cp", message, "a", NOW)
        told.append(arm.advance(0.0, STATE).joints)
    assert np.allclose(told, told[0], atol=1e-12)
    assert np.allclose(kinematics.forward_flat(told[0]), pose, atol=1e-12)


def test_an_unreachable_pose_warns_and_changes_nothing():
    arm = psm()
    far = PoseStamped(Header(0, "PSM2_base"), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    arm.receive("servo_cp", far, "a", NOW)
    assert arm.advance(0.0, STATE) is None
    assert [note.level for note in arm.notes] == ["warning"]


@pytest.mark.parametrize("command", ["disable", "pause", "fault", "unhome"])
def test_a_stopped_arm_stays_where_it_was_measured_and_keeps_its_grip(command):
    arm = psm()
    measured = tuple(np.add(START, 0.001))
    state = dataclasses.replace(STATE, joints=measured, jaw_setpoint=0.0)
    arm.receive("move_jp", joints(np.add(START, [0.3, 0, 0, 0, 0, 0])), "a", NOW)
    arm.advance(0.0, state)
    arm.receive("state_command", say(command), "b", NOW)
    target = arm.advance(0.02, state)
    assert target.joints == measured
    assert target.jaw == 0.0
    assert not arm.is_busy
    arm.receive("servo_jp", joints(START), "a", NOW)
    assert arm.advance(0.04, state) is None
    assert any("rejected servo_jp" in note.text for note in arm.notes)


def test_commands_that_waited_before_a_stop_are_not_obeyed_after_it():
    arm = psm()
    arm.receive("state_command", say("disable"), "a", NOW)
    arm.receive("move_jp", joints(START), "a", NOW)
    arm.receive("state_command", say("enable"), "a", NOW)
    arm.advance(0.0, STATE)
    assert not arm.is_busy
    assert arm.operating.may_move


@pytest.mark.parametrize(
    ("age_s", "problem"), [(0.3, "s old"), (-0.3, "ahead"), (0.0, "out of order")]
)
def test_a_late_or_old_motion_is_refused(age_s, problem):
    arm = psm()
    arm.receive("servo_jp", joints(START, stamp=NOW + 1000), "a", NOW)
    arm.advance(0.0, STATE)
    with pytest.raises(InputError, match=problem):
        arm.receive("servo_jp", joints(START, stamp=NOW - int(age_s * 1e9)), "a", NOW)


def test_two_clients_at_once_pause_the_arm():
    arm = psm()
    arm.receive("servo_jp", joints(START), "a", NOW)
    arm.receive("jaw/servo_jp", joints((0.5,), ()), "b", NOW)  # another part of the arm
    arm.receive("servo_jp", joints(np.add(START, 0.01)), "b", NOW + 10**8)
    assert arm.operating.state == "PAUSED"
    assert [note.level for note in arm.notes] == ["error"]
    target = arm.advance(0.0, STATE)
    assert target is None or target.joints == STATE.joints
    arm.receive("state_command", say("resume"), "a", NOW)
    arm.advance(0.02, STATE)
    later = NOW + int(2e9)
    arm.receive("servo_jp", joints(np.add(START, 0.01)), "b", later)
    assert arm.advance(0.04, STATE).joints[0] == pytest.approx(START[0] + 0.01)


def test_the_endoscope_has_a_state_and_stands_still():
    arm = Endoscope("ECM")
    with pytest.raises(InputError, match="is fixed"):
        arm.receive("servo_jp", joints((0.0,) * 4), "a", NOW)
    arm.receive("state_command", say("disable"), "a", NOW)
    assert arm.operating.state == "DISABLED"


def test_the_topics_are_those_of_the_contract():
    """docs/ros_crtk_contract.md of dvrk_simulator_base, second paragraph."""
    said = set(topics.psm_topics("PSM1", heard=False))
    heard = set(topics.psm_topics("PSM1", heard=True))
    assert said == {
        *("measured_js", "setpoint_js", "measured_cp", "setpoint_cp", "measured_cv"),
        *("operating_state", "state", "info", "warning", "error", "tool_type"),
        *("jaw/measured_js", "jaw/setpoint_js", "local/measured_cp", "local/setpoint_cp"),
    }
    assert heard == {
        *("servo_jp", "move_jp", "servo_cp", "move_cp", "state_command"),
        *("jaw/servo_jp", "jaw/move_jp"),
    }
    qualities = topics.psm_topics("PSM1", heard=False)
    assert qualities["operating_state"].quality == topics.EVENT
    assert qualities["tool_type"].quality == topics.LATCHED
