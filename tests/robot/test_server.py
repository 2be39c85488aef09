"""The served simulation, over an in-process transport."""

import dataclasses
import functools
import json
import math

import numpy as np
import pytest
from memory_transport import MemoryTransport

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import absolute, poses
from surgicai_vision.envs.control import JAW_OPEN, StepSize, moved
from surgicai_vision.robot import frames, topics
from surgicai_vision.robot.arm import FINGER_SHARE, JOINT_NAMES
from surgicai_vision.robot.messages import Header, JointState, PoseStamped, StringStamped
from surgicai_vision.robot.server import CONTROL_S, ServeConfig, Server
from surgicai_vision.robot.simulated import SimulatedRobot
from surgicai_vision.scene import kinematics

SEED = 900_003


@functools.cache
def env_of(task):
    return envs.make(TaskConfig(task))


class Client:
    """Publishes commands to a server in the same process and reads what it publishes."""

    def __init__(self, task="grasp", source="client", **config):
        self.env = env_of(task)
        self.robot = SimulatedRobot(self.env)
        self.robot.reset(SEED)
        self.transport = MemoryTransport(source=source)
        known = {
            **{
                topic.name: topic
                for name in ("PSM1", "PSM2")
                for heard in (True, False)
                for topic in topics.psm_topics(name, heard=heard).values()
            },
            **{
                topic.name: topic
                for topic in (
                    *topics.ecm_topics("ECM", heard=False).values(),
                    *(topics.STEP, topics.STEPPED, topics.RESET, topics.ENTER),
                    *(topics.JUDGEMENT, topics.NEEDLE, topics.LABEL),
                    *(topics.image_topic("front"), topics.info_topic("front")),
                )
            },
        }
        self.topics = known
        self.inboxes = {name: self.transport.inbox(topic) for name, topic in known.items()}
        self.server = Server(self.robot, self.transport, ServeConfig("stepped", **config))
        self.server.__enter__()
        self.stamp = 1
        self.take()

    def take(self):
        """Return topic → the messages since the last call."""
        taken = {name: [r.message for r in inbox()] for name, inbox in self.inboxes.items()}
        return {name: messages for name, messages in taken.items() if messages}

    def say(self, topic, message):
        self.transport.publisher(self.topics[topic])(message)

    def step(self, **commands):
        """Send commands, request a step and return what the server then publishes."""
        self.stamp += 1
        for topic, message in commands.items():
            self.say(topic, message)
        self.say(topics.STEP.name, StringStamped(Header(self.stamp), " ".join(commands)))
        self.server.poll()
        return self.take()


@pytest.fixture(scope="module")
def client():
    return Client()


def test_everything_of_a_step_bears_one_stamp(client):
    said = client.step()
    (stepped,) = said["/simulation/stepped"]
    assert stepped.text == str(client.stamp)
    for name in ("measured_js", "setpoint_cp", "measured_cv", "jaw/measured_js"):
        (message,) = said[f"/PSM1/{name}"]
        assert message.header.stamp == stepped.header.stamp
    assert said["/ECM/measured_cp"][0].header.frame == "world"


def test_what_is_measured_is_what_the_simulation_reports(client):
    said = client.step()
    simulation = client.env.simulation
    for arm in names.ARMS:
        name = arm.upper()
        assert np.allclose(
            said[f"/{name}/measured_js"][0].position, simulation.reported_joints(arm)
        )
        local = frames.read_pose(said[f"/{name}/local/measured_cp"][0])
        assert np.allclose(local, simulation.tip_in_base(arm), atol=1e-9)
        seen = said[f"/{name}/measured_cp"][0]
        assert seen.header.frame == "ECM_view"
        in_world = poses.compose(absolute.T_WORLD_VIEW, frames.read_pose(seen))
        assert np.allclose(in_world, simulation.tip(arm), atol=1e-9)
        jaw = said[f"/{name}/jaw/measured_js"][0].position[0]
        assert jaw * FINGER_SHARE == pytest.approx(simulation.jaw(arm))


def test_served_actions_move_as_the_envs_own_do():
    """Increments on the published set point, sent as servo_cp, move as the env itself does."""
    config = TaskConfig("grasp")
    own = envs.make(config)
    own.reset(seed=SEED)
    client = Client()
    rng = np.random.default_rng(0)
    step = StepSize.of(config.step)
    said = client.step()
    own.step(np.zeros(7, np.float32))
    for _ in range(60):
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        own.step(action)
        present = frames.read_pose(said["/PSM2/local/setpoint_cp"][0])
        jaw = said["/PSM2/jaw/setpoint_js"][0].position[0]
        jaw = min(max(jaw * FINGER_SHARE + action[6] * step.jaw, 0.0), JAW_OPEN) / FINGER_SHARE
        stamp = client.stamp + 1
        pose = frames.write_pose(moved(present, action.tolist(), step), stamp, "PSM2_base")
        said = client.step(
            **{
                "/PSM2/servo_cp": pose,
                "/PSM2/jaw/servo_jp": JointState(Header(stamp), ("jaw",), (float(jaw),)),
            }
        )
    assert np.allclose(client.env.data.qpos, own.data.qpos, atol=1e-9)


def test_a_step_waits_for_the_commands_it_names(client):
    before = client.robot.steps
    stamp = client.stamp = client.stamp + 1
    client.say(topics.STEP.name, StringStamped(Header(stamp), "/PSM2/jaw/servo_jp"))
    client.server.poll()
    assert client.robot.steps == before
    client.say("/PSM2/jaw/servo_jp", JointState(Header(stamp), ("jaw",), (0.5,)))
    client.server.poll()
    assert client.robot.steps == before + 1
    assert client.robot.state("PSM2").jaw_setpoint == pytest.approx(0.5)


def test_a_step_whose_commands_never_come_is_not_taken(client, monkeypatch):
    monkeypatch.setattr("surgicai_vision.robot.server.PATIENCE_S", 0.0)
    before = client.robot.steps
    said = client.step()
    client.say(topics.STEP.name, StringStamped(Header(client.stamp + 9), "/PSM2/servo_cp"))
    client.server.poll()
    said = client.take()
    assert "no message with that stamp" in said["/simulation/stepped"][0].text
    assert client.robot.steps == before + 1


@pytest.mark.parametrize(
    "message",
    [
        PoseStamped(Header(), (math.nan, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)),
        PoseStamped(Header(0, "moon"), (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)),
        PoseStamped(Header(), (0.0, 0.0, 9.0), (0.0, 0.0, 0.0, 1.0)),
    ],
)
def test_a_faulty_command_warns_and_the_arm_holds_still(client, message):
    before = client.robot.state("PSM2").setpoint
    steps = client.robot.steps
    header = dataclasses.replace(message.header, stamp=client.stamp + 1)
    said = client.step(**{"/PSM2/servo_cp": dataclasses.replace(message, header=header)})
    assert client.robot.steps == steps + 1
    assert client.robot.state("PSM2").setpoint == before
    assert any("rejected servo_cp" in note.text for note in said["/PSM2/warning"])


def test_an_emergency_stop_in_the_middle_of_a_move_holds_the_arm():
    client = Client()
    goal = tuple(np.add(client.robot.state("PSM1").joints, [0.2, 0, 0, 0, 0, 0]))
    client.say("/PSM1/move_jp", JointState(Header(), JOINT_NAMES, goal))
    for _ in range(10):
        client.step()
    client.say("/PSM1/state_command", StringStamped(Header(), "pause"))
    said = client.step()
    assert said["/PSM1/operating_state"][-1].state == "PAUSED"
    held = client.robot.state("PSM1").joints
    for _ in range(10):
        client.step()
    assert np.allclose(client.robot.state("PSM1").joints, held, atol=2e-3)
    client.say("/PSM1/move_jp", JointState(Header(), JOINT_NAMES, goal))
    said = client.step()
    assert "PAUSED" in said["/PSM1/warning"][0].text
    client.say("/PSM1/state_command", StringStamped(Header(), "resume"))
    client.say("/PSM1/move_jp", JointState(Header(), JOINT_NAMES, goal))
    for _ in range(150):
        client.step()
    assert client.robot.state("PSM1").joints[0] == pytest.approx(goal[0], abs=2e-3)
    assert client.take() == {}


def test_a_reset_begins_the_episode_of_its_seed_again():
    client = Client()
    start = client.env.get_state()
    for _ in range(5):
        client.say("/PSM2/jaw/servo_jp", JointState(Header(), ("jaw",), (0.2,)))
        client.step()
    assert not np.array_equal(client.env.get_state(), start)
    client.say("/simulation/reset", StringStamped(Header(7), str(SEED)))
    client.server.poll()
    said = client.take()
    assert said["/simulation/stepped"][0].text == "7"
    assert np.array_equal(client.env.get_state(), start)
    client.say("/simulation/reset", StringStamped(Header(8), "-1"))
    client.server.poll()
    assert "must be a seed" in client.take()["/simulation/stepped"][0].text


def test_the_seconds_of_a_served_simulation_go_on_over_resets(monkeypatch, capsys):
    class Asking(MemoryTransport):
        """Asks for a step whenever the server waits, and for a reset every third time."""

        waits = 0

        def wait(self, seconds):
            self.waits += 1
            assert self.waits < 20, "it never ends"
            self.publisher(topics.STEP)(StringStamped(Header(), ""))
            if self.waits % 3 == 0:
                self.publisher(topics.RESET)(StringStamped(Header(), str(SEED)))

    monkeypatch.setattr("surgicai_vision.robot.transport.open_transport", lambda *_: Asking())
    options = ("--task", "grasp", "--clock", "stepped", "--seconds", "0.14", "--json")
    assert main(["robot", "serve", *options]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "7 control steps.", "the client sets the clock: no step is late"
    assert json.loads(said[-1])["steps"] == 7


def test_a_recording_begins_from_a_training_start(monkeypatch, capsys, tmp_path):
    class Asking(MemoryTransport):
        """Asks for a step whenever the server waits."""

        def wait(self, seconds):
            self.publisher(topics.STEP)(StringStamped(Header(), ""))

    begun = []
    reset = SimulatedRobot.reset
    monkeypatch.setattr(SimulatedRobot, "reset", lambda *of: begun.append(of[1]) or reset(*of))
    monkeypatch.setattr("surgicai_vision.robot.transport.open_transport", lambda *_: Asking())
    options = ("--task", "grasp", "--clock", "stepped", "--seconds", "0.02")
    record = ("--record", str(tmp_path / "demos"))
    assert main(["robot", "serve", *options]) == 0
    assert main(["robot", "serve", *options, *record]) == 0
    assert begun == [names.TEST_SEED, names.TRAIN_SEED]
    assert main(["robot", "serve", *options, *record, "--seed", "900000"]) == 2
    assert "reserved for validation" in capsys.readouterr().err


def test_what_was_sent_before_a_reset_is_not_obeyed_after_it():
    """A client sends until its episode ends; its last command may be queued with the reset."""
    client = Client()
    client.step()
    before = client.env.get_state()
    client.say("/PSM2/jaw/servo_jp", JointState(Header(), ("jaw",), (0.2,)))
    client.say("/simulation/reset", StringStamped(Header(70), str(SEED)))
    client.step()
    assert np.array_equal(client.env.get_state(), before)
    client.say("/PSM2/jaw/servo_jp", JointState(Header(), ("jaw",), (0.2,)))
    client.step()
    assert client.robot.state("PSM2").jaw_setpoint < 0.8


def test_a_reset_forgets_the_stamps_of_the_last_client():
    """Stepped: another client's clock may be behind that of the one before it."""
    client = Client()
    late = 10**12

    def jaw(stamp, angle):
        return JointState(Header(stamp), ("jaw",), (angle,))

    client.stamp = late - 1
    client.step(**{"/PSM2/jaw/servo_jp": jaw(late, 0.5)})
    client.say("/simulation/reset", StringStamped(Header(7), str(SEED)))
    client.server.poll()
    client.say(topics.STEP.name, StringStamped(Header(8), "/PSM2/jaw/servo_jp"))
    client.server.poll()
    assert client.robot.steps == 0, "it waits for the command of this stamp"
    client.say("/PSM2/jaw/servo_jp", jaw(8, 0.3))
    client.server.poll()
    assert client.robot.steps == 1
    assert client.robot.state("PSM2").jaw_setpoint == pytest.approx(0.3)


def test_a_stop_sent_before_a_reset_is_obeyed_after_it():
    client = Client()
    client.say("/PSM2/state_command", StringStamped(Header(), "fault"))
    client.say("/simulation/reset", StringStamped(Header(70), str(SEED)))
    said = client.step()
    assert said["/PSM2/operating_state"][-1].state == "FAULT"


@pytest.mark.parametrize("text", ["", "-1", "1.5", "seed", "9" * 5000])
def test_a_reset_to_no_seed_is_answered_and_the_server_goes_on(text):
    client = Client()
    client.say("/simulation/reset", StringStamped(Header(70), text))
    answers = [said.text for said in client.step()["/simulation/stepped"]]
    assert any(answer.startswith("70 a reset's text must be a seed") for answer in answers)


def test_a_reset_to_a_seed_without_a_start_changes_nothing(monkeypatch):
    """No start of a seed may be physical; that seed ends neither the server nor the episode."""
    client = Client()
    client.step()
    before = client.env.get_state()
    monkeypatch.setattr("surgicai_vision.envs.base.START_DRAWS", 0)
    client.say("/simulation/reset", StringStamped(Header(70), "5"))
    client.server.poll()
    assert client.take()["/simulation/stepped"][0].text.startswith("70 No start of 'grasp'")
    assert np.array_equal(client.env.get_state(), before)
    assert (client.robot.seed, client.robot.steps) == (SEED, 1)


def test_a_request_that_comes_twice_is_met_once(client):
    """A client repeats a request that got no answer; without a stamp every request is new."""
    before = client.robot.steps
    for _ in range(3):
        client.say(topics.STEP.name, StringStamped(Header(client.stamp + 5), ""))
        client.server.poll()
    assert client.robot.steps == before + 1
    for _ in range(2):
        client.say(topics.STEP.name, StringStamped(Header(), ""))
        client.server.poll()
    assert client.robot.steps == before + 3
    client.stamp += 5


def test_a_view_that_nobody_hears_is_not_rendered(monkeypatch):
    client = Client(views=("front", "back"), size=(64, 64))
    rendered = []
    image = type(client.env).image
    monkeypatch.setattr(
        type(client.env),
        "image",
        lambda env, *given: rendered.append(given[0]) or image(env, *given),
    )
    said = client.step()
    assert len(said["/front/image_raw"]) == 1
    assert rendered == ["front"]


def test_the_truth_is_named_and_optional(client):
    assert "/needle/measured_cp" not in client.step()
    shown = Client("suture", shows_truth=True)
    said = shown.step()
    needle = said["/needle/measured_cp"][0]
    assert needle.header.frame == "world"
    assert np.allclose(frames.read_pose(needle), shown.env.simulation.needle(), atol=1e-9)
    assert said["/subtask"][0].text == "grasp"
    shown.say("/simulation/enter", StringStamped(Header(3), "place"))
    shown.server.poll()
    said = shown.take()
    assert said["/subtask"][0].text == "place"
    assert json.loads(said["/simulation/judgement"][-1].text)["subtask"] == "place"


def test_images_show_the_state_they_are_stamped_with():
    client = Client(views=("front",), size=(64, 80))
    said = client.step()
    image = said["/front/image_raw"][-1]
    assert image.header.stamp == said["/simulation/stepped"][0].header.stamp
    frame = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
    assert np.array_equal(frame, client.env.image("front", (64, 80)))
    info = said["/front/camera_info"][-1]
    intrinsics = client.env.calibration.intrinsics("front", (64, 80))
    assert np.allclose(info.intrinsics, intrinsics.ravel())


def test_in_real_time_two_states_are_published_a_control_step():
    client = Client()
    server = Server(client.robot, client.transport, ServeConfig())
    with server:
        client.take()
        ticks = iter([False] * 5)
        server.run(lambda: next(ticks, True))
    said = client.take()
    stamps = [message.header.stamp for message in said["/PSM1/measured_js"]]
    assert len(stamps) == 10
    assert stamps == sorted(set(stamps))
    assert len(said["/PSM1/jaw/measured_js"]) == 10
    assert len(server.lateness) == 5
    assert client.robot.steps == 5
    assert pytest.approx(client.env.dt) == CONTROL_S


def test_half_a_control_step_changes_nothing_of_the_whole():
    """The physics is the same, bit for bit, with or without a reading halfway."""
    plain, watched = (envs.make(TaskConfig("grasp")) for _ in range(2))
    seen = []
    for env in (plain, watched):
        env.reset(seed=SEED)
    command = plain.simulation.commands[names.PSM2]
    goal = tuple(np.add(command.joints, [0.01, 0, 0, 0, 0, 0]))
    command = command._replace(pose=kinematics.forward_flat(goal), joints=goal)
    for _ in range(5):
        plain.step_commands({names.PSM2: command})
        watched.step_commands(
            {names.PSM2: command}, lambda: seen.append(watched.data.qpos[:6].copy())
        )
    assert np.array_equal(plain.get_state(), watched.get_state())
    assert len(seen) == 5


def test_a_step_without_commands_is_a_step_of_zero_action():
    one, other = (envs.make(TaskConfig("place")) for _ in range(2))
    for env in (one, other):
        env.reset(seed=SEED)
    for _ in range(20):
        one.step(np.zeros(7, np.float32))
        other.step_commands({})
    assert np.allclose(one.get_state(), other.get_state(), atol=1e-7)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"randomisation": RandomisationConfig(latency=2)}, "latency"),
        ({"action_repeat": 2}, "action_repeat"),
        ({"hold_jaw": True}, "hold_jaw"),
    ],
)
def test_an_env_that_changes_actions_is_refused(changes, problem):
    """What is recorded of it would not be what its task says."""
    with pytest.raises(InputError, match=problem):
        SimulatedRobot(envs.make(TaskConfig("grasp", **changes)))
