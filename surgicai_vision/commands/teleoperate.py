"""`teleoperate`: drive the arms by keyboard or gamepad and record what succeeded."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter, validators

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    SEED,
    TASK,
    VIEWS,
    EnvFields,
    default_text,
    task_config,
    within,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.tasks import task_text
from surgicai_vision.core.words import plural
from surgicai_vision.demos.disturbance import check_told
from surgicai_vision.teleoperation.keyboard import key_table

app = App(
    name="teleoperate",
    help_epilogue=f"""\
example:
  surgicai-vision teleoperate --task grasp

keys (by their place on a US keyboard) and gamepad:
{key_table()}

Only successes are kept. The same command continues a session that was stopped or killed.""",
)
SECONDS = 60.0
"""Time a subtask may take [s]; the paper's 4 s suit a policy, not a person."""
WEB_PORT = 8765


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `teleoperate`.

    Attributes:
        task: The task.
        port: Port of the page on this machine's loopback; 0 takes any free port.
        view: Views to show; the first is the leading view.
        size: Height and width of images [px].
        frame: Axes that the keys refer to: those of the leading view's camera, or the tool's.
        speed: Share of the step size that a key or a full deflection commands.
        pace: Speed as a share of real time; 0.5 gives twice the time to react.
        seconds: Simulated seconds that an attempt may take.
        episodes: Stop after this many more episodes are kept.
        seed: Seed of the first start in a new folder.
        auto_keep: Keep a success without asking.
        keep_failures: Let → also keep an episode without success.
        skip_idle: Stop the world while nothing is held; pauses are not recorded.
        out: Folder to create or continue.
    """

    task: Annotated[str, TASK] = "grasp"
    port: Annotated[int, within(0, 65535)] = WEB_PORT
    view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")
    size: Annotated[int, within(64, 1024), Parameter(metavar="PX")] = 448
    frame: Annotated[str, Parameter(choices=("camera", "tool"))] = "camera"
    speed: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=1))] = 0.5
    pace: Annotated[float, Parameter(validator=validators.Number(gte=0.05, lte=4))] = 1.0
    seconds: Annotated[
        float | None,
        Parameter(validator=validators.Number(gte=0.1, lte=3600)),
        default_text(f"{SECONDS:g}, {SECONDS * len(names.SUBTASKS):g} for {names.SUTURE}"),
    ] = None
    episodes: Annotated[int | None, COUNT, default_text("continue until Esc")] = None
    seed: Annotated[int | None, SEED, default_text(str(names.TRAIN_SEED))] = None
    auto_keep: bool = False
    keep_failures: bool = False
    skip_idle: bool = False
    out: Annotated[Path | None, DIRECTORY, default_text("outputs/teleoperation/<task>")] = None
    env: EnvFields = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Let a person drive and record, and print what was kept."""
    from surgicai_vision import envs
    from surgicai_vision.core.pacer import Pacer
    from surgicai_vision.teleoperation.input_map import InputMapping
    from surgicai_vision.teleoperation.loop import EnvViews, run_session
    from surgicai_vision.teleoperation.recordings import open_recordings
    from surgicai_vision.teleoperation.session import Rules, Session
    from surgicai_vision.teleoperation.web import WebView

    config = _config(options)
    out = options.out or folders.OUTPUTS / "teleoperation" / options.task
    folders.check_folder(out, "demos.json")
    rules = Rules(options.episodes, options.auto_keep, options.keep_failures, options.skip_idle)
    with WebView(options.view, task_text(options.task), options.port) as page:
        env = envs.make(config)
        with open_recordings(out, config, env.scene.hash, options.seed) as recordings:
            session = Session(
                env,
                InputMapping(env, options.frame, options.speed),
                recordings,
                options.view,
                rules,
            )
            views = EnvViews(env, options.view, options.size)
            for line in page.server.invitation:
                console.note(line)
            run_session(
                session,
                page,
                page,
                views,
                Pacer(options.pace),
                lambda status: _tell(console, status.message),
            )
    env.close()
    count = len(recordings.seeds)
    total = f"{plural(count, 'demonstration')}: {out}" if count else "no demonstrations yet."
    console.say(f"{session.kept} kept, {session.discarded} discarded; {total}")
    return {
        "task": options.task,
        "kept": session.kept,
        "discarded": session.discarded,
        "skipped": session.skipped,
        "steps": session.steps_kept,
        "episodes": count,
        "demos": str(out),
    }


def _config(options: Options) -> TaskConfig:
    """Return the task's configuration with the time that a person needs."""
    config = task_config(options.task, options.env)
    if config.action_repeat != 1:
        raise InputError(
            f"env: action_repeat is {config.action_repeat}; a person moves the arm at every "
            "control step. Leave it out ('export-demos' can hold the actions)."
        )
    check_told(config, "a session")
    if options.env and options.env.get("max_steps"):
        if options.seconds is not None:
            raise InputError("--seconds and env: max_steps set the same limit; give only one.")
        return config
    subtasks = len(names.SUBTASKS) if options.task == names.SUTURE else 1
    seconds = SECONDS * subtasks if options.seconds is None else options.seconds
    return dataclasses.replace(config, max_steps=max(1, round(seconds * names.FPS)))


def _tell(console: Console, message: str) -> None:
    """Print what became of an episode; the page shows the rest."""
    if message.startswith(("Kept", "Start", "Discarded")):
        console.note(message.split(" Move to")[0])
