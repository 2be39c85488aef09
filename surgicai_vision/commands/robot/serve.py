"""`robot serve`: the simulation as a dVRK that speaks CRTK."""

import dataclasses
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter, validators

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    DIRECTORY,
    DURATION,
    FILE_ONLY,
    IMAGE_SIZE,
    SEED,
    TASK,
    VIEWS,
    EnvFields,
    default_text,
    task_config,
)
from surgicai_vision.commands.robot.network import (
    INTERFACE,
    TRANSPORT,
    Domain,
    renamed_topics,
    ros_domain,
)
from surgicai_vision.core import names
from surgicai_vision.core.banks import check_training_starts
from surgicai_vision.core.config import ADVANCES, TaskConfig
from surgicai_vision.core.processes import Terminated

app = App(
    name="serve",
    help_epilogue="""\
example:
  surgicai-vision robot serve --task suture --view endo_left,endo_right

It serves until Ctrl-C. docs/robot.md lists the topics; the extra `ros` is needed.""",
)

SECONDS = 60.0
"""Time that a recorded subtask may take [s], as in `teleoperate`."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `robot serve`.

    Attributes:
        task: The task whose scene and starts are served.
        seed: Seed of the first start; a client requests others on /simulation/reset.
        clock: real, or stepped by the client on /simulation/step.
        view: Views whose images are published.
        size: Height and width of images [px].
        image_rate: Highest rate of each view's images, in real time [Hz].
        compressed: Publish JPEG files in addition to the raw images.
        advance: How the judge of the whole procedure moves to the next subtask: by success, or when
            told on /simulation/enter, as a hierarchical policy with learned ends needs.
        record: Keep every episode, from a reset to its success, as a demonstration in this folder,
            except from starts that are reserved for validation or tests.
        truth: Also publish the needle's pose and the present subtask, which no robot knows.
        transport: Middleware that carries the messages.
        interface: See `network.INTERFACE`.
        domain: See `network.Domain`.
        seconds: End after this many simulated seconds.
    """

    task: Annotated[str, TASK] = names.SUTURE
    seed: Annotated[
        int | None,
        SEED,
        default_text(f"{names.TEST_SEED}, {names.TRAIN_SEED} with --record"),
    ] = None
    clock: Annotated[str, Parameter(choices=("real", "stepped"))] = "real"
    view: Annotated[tuple[str, ...], VIEWS] = ()
    size: Annotated[int, IMAGE_SIZE] = 224
    image_rate: Annotated[
        float, Parameter(validator=validators.Number(gt=0, lte=100), metavar="HZ")
    ] = 50.0
    compressed: bool = False
    advance: Annotated[str, Parameter(choices=ADVANCES)] = ADVANCES[0]
    record: Annotated[Path | None, DIRECTORY, default_text("record nothing")] = None
    truth: bool = False
    transport: Annotated[str, TRANSPORT] = "cyclonedds"
    interface: Annotated[str, INTERFACE] = "lo"
    domain: Domain = None
    seconds: Annotated[float | None, DURATION, default_text("until Ctrl-C")] = None
    env: EnvFields = None
    topics: Annotated[dict[str, object] | None, FILE_ONLY] = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Serve the simulation until it is interrupted, and print how well it kept time."""
    import numpy as np

    from surgicai_vision import envs
    from surgicai_vision.demos.store import MARKER
    from surgicai_vision.robot.recorder import Recorder
    from surgicai_vision.robot.server import ServeConfig, Server
    from surgicai_vision.robot.simulated import SimulatedRobot
    from surgicai_vision.robot.transport import LOOPBACK, RenamedTransport, open_transport
    from surgicai_vision.teleoperation.recordings import open_recordings

    domain = ros_domain(options.domain)
    seed = _seed(options)
    config = ServeConfig(
        options.clock,
        options.view,
        (options.size, options.size),
        options.image_rate,
        options.compressed,
        options.truth,
    )
    if options.record is not None:
        folders.check_folder(options.record, MARKER, "--record")
    with ExitStack() as stack:
        opened = stack.enter_context(open_transport(options.transport, options.interface, domain))
        transport = RenamedTransport(opened, renamed_topics(options.topics), options.view)
        env = envs.make(_task(options))
        robot = SimulatedRobot(env)
        robot.reset(seed)
        recorder = None
        if options.record is not None:
            recordings = stack.enter_context(
                open_recordings(options.record, env.config, env.scene.hash)
            )
            recorder = Recorder(robot, recordings, console.note)
        limit = None if options.seconds is None else round(options.seconds * names.FPS)
        with Server(robot, transport, config, recorder) as server:
            reach = (
                "this machine only"
                if options.interface == LOOPBACK
                else f"everyone on {options.interface} may move the arms"
            )
            console.note(
                f"serving {options.task} as PSM1, PSM2 and ECM: domain {domain}, {reach}; "
                "Ctrl-C ends it"
            )
            try:
                server.run(lambda: limit is not None and server.steps >= limit)
            except KeyboardInterrupt as interrupt:
                if isinstance(interrupt, Terminated):
                    raise
            late = 1e3 * np.array(server.lateness or [0.0])
        env.close()
    kept_time = (
        f"; they began late by {np.median(late):.2f} ms (median) and "
        f"{np.percentile(late, 99):.2f} ms (99th percentile)"
    )
    console.say(f"{server.steps} control steps{kept_time if server.lateness else ''}.")
    return {
        "task": options.task,
        "domain": domain,
        "interface": options.interface,
        "steps": server.steps,
        "late_ms_median": float(np.median(late)),
        "late_ms_p99": float(np.percentile(late, 99)),
    }


def _seed(options: Options) -> int:
    """Return the seed of the first start; what is recorded begins from training starts."""
    if options.record is None:
        return names.TEST_SEED if options.seed is None else options.seed
    seed = names.TRAIN_SEED if options.seed is None else options.seed
    check_training_starts(seed, 1)
    return seed


def _task(options: Options) -> TaskConfig:
    """Return the task; recorded episodes may take the time that a person needs."""
    task = dataclasses.replace(task_config(options.task, options.env), advance=options.advance)
    if options.record is None or (options.env or {}).get("max_steps"):
        return task
    subtasks = len(names.SUBTASKS) if options.task == names.SUTURE else 1
    return dataclasses.replace(task, max_steps=round(SECONDS * names.FPS) * subtasks)
