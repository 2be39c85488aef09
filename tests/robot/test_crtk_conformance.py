"""Semantic conformance: what CRTK's numbers mean, measured through the topics alone.

Each test puts the question of a probe of the public project DeanDonkov/crtk-conformance
("Structural Conformance Is Not Semantic Conformance", 2026; its README and
src/crtk_conformance/probes/) to the served simulation, in our own words and code. The simulation
runs in real time on the test's own clock.
FrameSemanticsProbe is about frames, ScalingUnitsProbe and GeometryAnchorProbe about units,
RateSensitivityProbe about states, silence and rates. Where that project needs a tracker as an
anchor in metres, the simulation's own tip serves as one.
"""

import math

import numpy as np
import pytest
from virtual_time import VirtualTime

from surgicai_vision.envs import poses
from surgicai_vision.envs.absolute import T_WORLD_VIEW
from surgicai_vision.robot import topics
from surgicai_vision.robot.frames import read_pose, write_pose
from surgicai_vision.robot.messages import Header, JointState, StringStamped
from surgicai_vision.scene.kinematics import INSTRUMENTS

TOLERANCE_M = 1e-3
"""Task tolerance [m] (crtk-conformance's example)."""
SPEED = 0.05
"""Speed of a tip [m/s], same source; with the tolerance it requires 50 commands per second."""
REACH_M = 0.1
"""Radius of the workspace [m] over which an error of angle or scale grows, same source."""
STEP_M = 0.005
SETTLES_S = 0.6


class Probe:
    """A client that knows the topics of one arm, and nothing of the simulation behind them."""

    def __init__(self, monkeypatch, arm="PSM2"):
        self.served = VirtualTime(monkeypatch, "grasp", 0.003)
        said = topics.psm_topics(arm, heard=False)
        self.inboxes = {name: self.served.inbox(topic) for name, topic in said.items()}
        heard = topics.psm_topics(arm, heard=True)
        self.say = {name: self.served.publisher(topic) for name, topic in heard.items()}
        self.samples = {name: [] for name in said}
        self.wait(0.3)

    def wait(self, seconds):
        """Let time pass, and keep what was published as (time, message)."""
        ends = self.served.now + seconds
        while self.served.now < ends - 1e-9:
            self.served.pass_time(min(0.005, ends - self.served.now))
            for name, inbox in self.inboxes.items():
                self.samples[name] += [(self.served.now, entry.message) for entry in inbox()]

    def newest(self, name):
        return self.samples[name][-1][1]

    def pose(self, name="measured_cp"):
        return read_pose(self.newest(name))

    def texts(self, name):
        return " ".join(message.text for _, message in self.samples[name])

    def since(self, name, begun):
        return [message for time, message in self.samples[name] if time > begun]

    def servo(self, pose, frame=""):
        self.say["servo_cp"](write_pose(pose, 0, frame))

    def command(self, text):
        self.say["state_command"](StringStamped(Header(0), text))
        self.wait(0.05)

    def joints(self):
        return np.array(self.newest("measured_js").position)

    def servo_joints(self, values):
        names = self.newest("measured_js").names
        self.say["servo_jp"](JointState(Header(0), names, tuple(map(float, values))))

    def go(self, pose):
        """Go to a pose in the default frame in ten control steps, and settle."""
        start = self.pose("setpoint_cp")
        for share in np.linspace(0.1, 1.0, 10):
            place = np.add(start[:3], share * np.subtract(pose[:3], start[:3]))
            self.servo((*place.tolist(), *pose[3:]))
            self.wait(0.02)
        self.wait(SETTLES_S)


@pytest.fixture
def probe(monkeypatch):
    return Probe(monkeypatch)


def shifted(pose, axis, step):
    place = list(pose[:3])
    place[axis] += step
    return (*place, *pose[3:])


# -- frames: FrameSemanticsProbe -------------------------------------------------------------------


@pytest.mark.parametrize("arm", ["PSM1", "PSM2"])
def test_unqualified_poses_are_local_ones_in_the_declared_frame(monkeypatch, arm):
    """Measured_cp · local/measured_cp⁻¹ is one transform wherever the arm is: the base's pose."""
    probe = Probe(monkeypatch, arm)
    declared = poses.compose(poses.invert(T_WORLD_VIEW), probe.served.robot.base(arm))
    for step in (0.0, STEP_M, -STEP_M):
        probe.go(shifted(probe.pose(), 0, step))
        for kind in ("measured", "setpoint"):
            found = poses.compose(
                probe.pose(f"{kind}_cp"), poses.invert(probe.pose(f"local/{kind}_cp"))
            )
            angle = poses.angle(found, declared)
            error = poses.distance(found, declared) + 2.0 * math.sin(angle / 2.0) * REACH_M
            assert error < 1e-6


def test_frame_ids_tell_the_unqualified_frame_from_the_local_one(probe):
    """The two differ by a transform, so their headers must differ too."""
    assert poses.distance(probe.pose(), probe.pose("local/measured_cp")) > TOLERANCE_M
    assert probe.newest("measured_cp").header.frame == "ECM_view"
    assert probe.newest("setpoint_cp").header.frame == "ECM_view"
    assert probe.newest("local/measured_cp").header.frame == "PSM2_base"


@pytest.mark.parametrize("frame", ["", "ECM_view"])
def test_a_set_point_sent_back_moves_nothing(probe, frame):
    """Servo_cp reads the frame that setpoint_cp and measured_cp are written in."""
    before = probe.pose()
    told = probe.pose("setpoint_cp")
    for _ in range(25):
        probe.servo(told, frame)
        probe.wait(0.02)
    assert poses.distance(probe.pose(), before) < 1e-5


# -- units: ScalingUnitsProbe, GeometryAnchorProbe -------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_is_commanded_is_what_is_measured(probe, axis):
    """The internal ratio is 1 along each axis, there and back."""
    for step in (STEP_M, -STEP_M):
        start = probe.pose()
        probe.go(shifted(probe.pose("setpoint_cp"), axis, step))
        moved = np.subtract(probe.pose()[:3], start[:3])
        wanted = np.zeros(3)
        wanted[axis] = step
        assert np.linalg.norm(moved) / abs(step) == pytest.approx(1.0, abs=0.02)
        assert np.allclose(moved, wanted, atol=2e-4)


def test_a_unit_is_a_metre(probe):
    """Anchored: the tip itself moves as many metres as were commanded."""
    scales = []
    for axis in (0, 1, 2):
        start = np.array(probe.served.robot.env.simulation.tip("psm2")[:3])
        probe.go(shifted(probe.pose("setpoint_cp"), axis, STEP_M))
        there = np.array(probe.served.robot.env.simulation.tip("psm2")[:3])
        scales.append(np.linalg.norm(there - start) / STEP_M)
    assert abs(1.0 - np.mean(scales)) * REACH_M < TOLERANCE_M


def test_the_wrists_two_axes_are_as_far_apart_as_the_instruments(probe):
    """The common normal of the pitch and yaw screw axes has the instrument's own length."""
    rest = probe.joints()
    axes = []
    for joint in (4, 5):
        start = probe.pose()
        turned = rest.copy()
        turned[joint] += 0.3
        for share in np.linspace(0.1, 1.0, 10):
            probe.servo_joints(rest + share * (turned - rest))
            probe.wait(0.02)
        probe.wait(SETTLES_S)
        axes.append(screw_axis(start, probe.pose(), 0.3))
        probe.servo_joints(rest)
        probe.wait(SETTLES_S)
    (first, along), (second, across) = axes
    normal = np.cross(along, across)
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=0.01)  # at right angles
    length = abs(np.dot(second - first, normal)) / np.linalg.norm(normal)
    assert length == pytest.approx(INSTRUMENTS["400006"].pitch_to_yaw, rel=0.02)


def screw_axis(start, end, angle):
    """Return a point on the axis of a pure turn by `angle` between two poses, and its direction."""
    turn = np.reshape(end[3:], (3, 3)) @ np.reshape(start[3:], (3, 3)).T
    skew = (turn - turn.T) / 2.0
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    assert math.asin(np.linalg.norm(axis)) == pytest.approx(angle, abs=0.01)
    axis /= np.linalg.norm(axis)
    assert abs(np.dot(np.subtract(end[:3], start[:3]), axis)) < 1e-4  # it does not slide along
    place = np.linalg.lstsq(np.eye(3) - turn, np.array(end[:3]) - turn @ start[:3], rcond=None)
    return place[0], axis


# -- states, silence and rates: RateSensitivityProbe -----------------------------------------------


def test_a_disabled_arm_does_not_move_and_an_enabled_one_does(probe):
    """The operating state is a precondition, and it is reported."""
    probe.command("disable")
    assert probe.newest("operating_state").state == "DISABLED"
    before = probe.pose()
    goal = shifted(probe.pose("setpoint_cp"), 0, STEP_M)
    probe.servo(goal)
    probe.wait(0.5)
    assert poses.distance(probe.pose(), before) < 2e-4
    assert "DISABLED" in probe.texts("warning")
    probe.command("enable")
    probe.command("home")
    state = probe.newest("operating_state")
    assert (state.state, state.is_homed, state.is_busy) == ("ENABLED", True, False)
    probe.go(goal)
    assert poses.distance(probe.pose(), goal) < TOLERANCE_M / 2


@pytest.mark.parametrize("gap", [0.1, 0.5, 2.0])
def test_an_arm_holds_its_set_point_through_a_silence(probe, gap):
    """Stop behaviour "hold": no drift during the silence, and the next command is obeyed."""
    goal = shifted(probe.pose("setpoint_cp"), 0, STEP_M)
    probe.go(goal)
    held = probe.pose()
    begun = probe.served.now
    probe.wait(gap)
    drifts = [poses.distance(read_pose(m), held) for m in probe.since("measured_cp", begun)]
    assert max(drifts) < 1e-4
    back = shifted(goal, 0, -STEP_M)
    probe.go(back)
    assert poses.distance(probe.pose(), back) < TOLERANCE_M / 2


def test_states_come_a_hundred_times_a_second(probe):
    """Evenly, and each with a later stamp than the one before."""
    begun = probe.served.now
    probe.wait(1.0)
    for name in ("measured_js", "measured_cp", "setpoint_cp", "jaw/measured_js"):
        stamps = np.array([m.header.stamp for m in probe.since(name, begun)])
        assert len(stamps) == pytest.approx(100, abs=1)
        assert np.allclose(np.diff(stamps) / 1e9, 0.01, atol=1e-4)


@pytest.mark.parametrize(("rate", "obeyed"), [(25, 25), (50, 50), (100, 50)])
def test_each_set_point_of_a_50_hz_client_is_obeyed(probe, rate, obeyed):
    """Faster ones supersede each other; 50 per second keep the tolerance at `SPEED` (v / ε)."""
    start = probe.pose("setpoint_cp")
    begun = probe.served.now
    for number in range(rate):
        probe.servo(shifted(start, 0, 1e-4 * (number + 1)))
        probe.wait(1.0 / rate)
    probe.wait(0.1)
    places = np.array([read_pose(m)[0] for m in probe.since("setpoint_cp", begun)])
    seen = set(np.round((places - start[0]) / 1e-4).tolist()) - {0.0}
    assert len(seen) == pytest.approx(obeyed, abs=1)
    assert max(seen) == rate
    assert rate < 50 or SPEED / obeyed <= TOLERANCE_M


@pytest.mark.parametrize("wait", [0.001, 0.006, 0.011, 0.016])
def test_a_command_shows_within_two_control_steps(probe, wait):
    """The first motion follows within 40 ms, wherever in a control step the set point arrives."""
    probe.wait(0.5 + wait)
    before = probe.pose()
    begun = probe.served.now
    probe.servo(shifted(probe.pose("setpoint_cp"), 0, 1e-3))
    probe.wait(0.04)
    after = [read_pose(m) for m in probe.since("measured_cp", begun)]
    assert max(poses.distance(pose, before) for pose in after) > 1e-5
