"""`robot drive`: a policy drives a dVRK, simulated or real, over CRTK."""

import json
import os
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.evaluate import open_given
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    DURATION,
    FILE_ONLY,
    SEED,
    AcceptLicence,
    EnvFields,
    PolicyTask,
    WeightFiles,
    default_text,
)
from surgicai_vision.commands.robot.network import (
    INTERFACE,
    TRANSPORT,
    Domain,
    renamed_topics,
    ros_domain,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.processes import Terminated
from surgicai_vision.features.encoders import WeightsSource

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from surgicai_vision.demos.imports.rosbag.config import Frames
    from surgicai_vision.evaluation.agent import Agent
    from surgicai_vision.evaluation.policy_spec import PolicySpec
    from surgicai_vision.robot.driver import DriveConfig, DrivenEpisode, Driver
    from surgicai_vision.robot.transport import Transport

app = App(
    name="drive",
    help_epilogue="""\
example:
  surgicai-vision robot drive released:suture --simulated --clock stepped --send
it drives the simulation that this command serves in another terminal:
  surgicai-vision robot serve --task suture --clock stepped --advance told \\
      --view front_psm1,front_psm2,back_psm1,back_psm2

Without --send nothing is sent: the command prints what it would send. docs/robot.md describes the
guards.""",
)
LOG = "drive.jsonl"
LONGEST_LINE = 1 << 20
"""More bytes than a line of the log has."""
KEY = "key"
NONE = "none"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `robot drive`.

    Attributes:
        policy: A checkpoint folder, a hierarchical.yaml, released:NAME (see `policies`) or
            module:factory.
        task: The task.
        send: Send the policy's commands to the robot; otherwise only print them.
        simulated: The robot is a simulation of `robot serve`, which starts and judges episodes.
        clock: real, or stepped if the simulation is served with --clock stepped.
        dead_man: Dead-man's switch that a person holds: key (the space bar), the topic of a
            sensor_msgs/Joy, or none, for a served simulation only.
        episodes: With --simulated, the number of episodes.
        seed: Seed of the first start.
        seconds: Time limit of an episode [s].
        compressed: Read the compressed images instead of the raw ones.
        transport: Middleware that carries the messages.
        interface: See `network.INTERFACE`.
        domain: See `network.Domain`.
        out: Folder of the log; new episodes are appended.
    """

    policy: Annotated[str, Parameter(metavar="POLICY")] = field(kw_only=False)
    task: PolicyTask = None
    send: bool = False
    simulated: bool = False
    clock: Annotated[str, Parameter(choices=("real", "stepped"))] = "real"
    dead_man: Annotated[
        str | None,
        Parameter(metavar="key|TOPIC|none"),
        default_text("key; none for a served simulation"),
    ] = None
    episodes: Annotated[int, COUNT] = 1
    seed: Annotated[int, SEED] = names.TEST_SEED
    seconds: Annotated[float | None, DURATION, default_text("the task's own")] = None
    compressed: bool = False
    transport: Annotated[str, TRANSPORT] = "cyclonedds"
    interface: Annotated[str, INTERFACE] = "lo"
    domain: Domain = None
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    out: Annotated[Path | None, DIRECTORY, default_text("outputs/drive/<task>-<policy>")] = None
    env: EnvFields = None
    guards: Annotated[dict[str, object] | None, FILE_ONLY] = None
    topics: Annotated[dict[str, object] | None, FILE_ONLY] = None
    frames: Annotated[dict[str, object] | None, FILE_ONLY] = None
    jaw_scale: Annotated[float | None, FILE_ONLY] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Drive, and print how many steps were sent or held back, and how late."""
    from surgicai_vision.demos.imports.rosbag.config import Frames
    from surgicai_vision.robot.driver import DriveConfig, check_drivable
    from surgicai_vision.robot.guards import GuardConfig

    config = DriveConfig(
        from_mapping(GuardConfig, options.guards or {}, "guards"),
        options.send,
        options.simulated,
        options.clock == "stepped",
    )
    frames = from_mapping(Frames, options.frames or {}, "frames")
    switch = _switch(options)
    spec = open_given(
        console,
        options.policy,
        options.task,
        options.env,
        None,
        WeightsSource.parse(options.weights, options.accept_licence),
    )
    out = options.out or folders.OUTPUTS / "drive" / f"{spec.config.task}-{spec.name}"
    folders.check_folder(out, LOG)
    agent = spec.make_agent()
    check_drivable(agent, spec.config)
    with ExitStack() as stack:
        driver = _driver(options, spec, agent, config, frames, switch, out, stack, console)
        episodes = _drive(driver, options, spec.config, console)
    return _told(options, spec, episodes, out / LOG, console)


def _driver(
    options: Options,
    spec: "PolicySpec",
    agent: "Agent",
    config: "DriveConfig",
    frames: "Frames",
    switch: str,
    out: Path,
    stack: ExitStack,
    console: Console,
) -> "Driver":
    """Return the driver, connected to the robot, with its log begun.

    Args:
        options: the command's options.
        spec: the policy that drives.
        agent: its agent.
        config: how it drives.
        frames: the robot's frames, where they differ from ours.
        switch: the dead-man's switch, as `_switch` returns it.
        out: the log's folder.
        stack: closes what is opened.
        console: prints what a dry run would send.
    """
    from surgicai_vision.core.files import code_version
    from surgicai_vision.robot.arm import FINGER_SHARE
    from surgicai_vision.robot.client import Client, ClientConfig
    from surgicai_vision.robot.driven import DrivenRobot
    from surgicai_vision.robot.driver import Driver
    from surgicai_vision.robot.transport import RenamedTransport, open_transport

    jaw_scale = FINGER_SHARE if options.jaw_scale is None else options.jaw_scale
    views = tuple(agent.cameras)
    transport = stack.enter_context(
        open_transport(options.transport, options.interface, ros_domain(options.domain))
    )
    dead_man = _dead_man(switch, transport, stack)
    client = Client(
        RenamedTransport(transport, renamed_topics(options.topics), views),
        ClientConfig(
            views=views,
            is_compressed=options.compressed,
            is_simulated=options.simulated,
        ),
    )
    robot = DrivenRobot(client, views, spec.config.task, agent.image_size, frames, jaw_scale)
    client.connect()
    out.mkdir(parents=True, exist_ok=True)
    _cut_torn_line(out / LOG)
    log = stack.enter_context((out / LOG).open("a", buffering=1, encoding="utf-8"))
    about = {
        "policy": options.policy,
        "task": spec.config.task,
        "guards": asdict(config.guards),
        "sends": options.send,
        "code_version": code_version(),
    }
    log.write(json.dumps(about) + "\n")
    return Driver(agent, robot, spec.config, config, dead_man, log, console.note)


def _drive(
    driver: "Driver", options: Options, task: TaskConfig, console: Console
) -> "list[DrivenEpisode]":
    """Drive the requested episodes, or until Ctrl-C; return those that ended."""
    limit = task.max_steps
    if options.seconds is not None:
        limit = max(1, round(options.seconds * names.FPS))
    if not options.send:
        console.note("dry run: nothing is sent; --send sends it")
    episodes = []
    try:
        for number in range(options.episodes if options.simulated else 1):
            episode = driver.episode(options.seed + number, limit)
            episodes.append(episode)
            console.say(
                f"{_about(episode.seed, options)}: {episode.ended}; {episode.steps} control "
                f"steps, {episode.held} held back"
            )
    except KeyboardInterrupt as interrupt:
        if isinstance(interrupt, Terminated):
            raise
        console.note("interrupted: nothing more is sent")
    return episodes


def _told(
    options: Options,
    spec: "PolicySpec",
    episodes: "Sequence[DrivenEpisode]",
    log: Path,
    console: Console,
) -> dict[str, object]:
    """Print the latencies and how many episodes succeeded; return these and each episode."""
    import numpy as np

    late = [value for episode in episodes for value in episode.latencies]
    seen = [value for episode in episodes for value in episode.image_latencies]
    figures: dict[str, float] = {}
    for name, what, values in (("latency", "pose", late), ("image_latency", "image", seen)):
        milliseconds = 1e3 * np.array(values or [0.0])
        median, high = float(np.median(milliseconds)), float(np.percentile(milliseconds, 99))
        figures |= {f"{name}_ms_median": median, f"{name}_ms_p99": high}
        if values:
            console.say(
                f"from the newest {what} to sending: median {median:.1f} ms, p99 {high:.1f} ms."
            )
    successes = sum(bool(episode.success) for episode in episodes)
    if options.simulated:
        console.say(f"{successes} of {len(episodes)} episodes succeeded.")
    console.say(f"log: {log}")
    return {
        "policy": spec.name,
        "task": spec.config.task,
        "sent": options.send,
        "log": str(log),
        **figures,
        "successes": successes if options.simulated else None,
        "episodes": [
            {
                "seed": episode.seed,
                "success": episode.success,
                "progress": episode.progress,
                "steps": episode.steps,
                "held": episode.held,
                "ended": episode.ended,
            }
            for episode in episodes
        ],
    }


def _switch(options: Options) -> str:
    """Return the dead-man's switch: `KEY`, `NONE` or a topic.

    Raises:
        InputError: "none" for a real robot, or something that is not a switch.
    """
    from surgicai_vision.robot.topics import check_topic

    given = options.dead_man or (NONE if options.simulated else KEY)
    if given == NONE and not options.simulated:
        raise InputError(
            "--dead-man none is for a served simulation; at a robot, a person holds the switch."
        )
    if given in (KEY, NONE):
        return given
    if not given.startswith("/"):
        raise InputError(f"--dead-man is '{given}'; allowed: {KEY}, {NONE} or a topic, /NAME.")
    check_topic(given, "--dead-man")
    return given


def _dead_man(switch: str, transport: "Transport", stack: ExitStack) -> "Callable[[], float]":
    """Return a function that says for how long the dead-man's switch was not held [s].

    Raises:
        InputError: the space bar is the switch, and standard input is no terminal.
    """
    from surgicai_vision.robot.dead_man import HeldKey, HeldPedal

    if switch == NONE:
        return lambda: 0.0
    if switch == KEY:
        return stack.enter_context(HeldKey()).age
    return HeldPedal(transport, switch).age


def _cut_torn_line(log: Path) -> None:
    """Cut the incomplete last line that a kill or a full disk leaves; the next one would join it.

    Args:
        log: the log; it need not exist.
    """
    if not log.exists():
        return
    with log.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - LONGEST_LINE))
        tail = file.read()
        if tail and not tail.endswith(b"\n"):
            file.truncate(size - len(tail) + tail.rfind(b"\n") + 1)


def _about(seed: int, options: Options) -> str:
    """Return how messages name an episode."""
    return f"start {seed}" if options.simulated else "the run"
