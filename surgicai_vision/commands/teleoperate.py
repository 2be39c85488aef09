"""`teleoperate`: drive the arms by keyboard or gamepad and record what succeeded."""

import dataclasses
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    config_only,
    many_of,
    not_negative,
    one_of,
    option,
    positive,
    task_config,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.teleoperation.keyboard import key_table

EXAMPLE = "surgicai-vision teleoperate --task grasp"
NOTES = f"""keys (by their place on a US keyboard) and gamepad:
{key_table()}

Only successes are kept. The same command goes on where a session was stopped or killed."""

SECONDS = 60.0
"""Time a subtask may take [s]; the paper's 4 s suit a policy, not a hand."""
SIZES = (64, 1024)
PACES = (0.05, 4.0)
WEB_PORT = 8765


def _speed(name: str, value: float) -> None:
    if not 0 < value <= 1:
        raise InputError(f"{name} is {value}; it must be above 0 and at most 1.")


def _within(low: float, high: float) -> Any:
    """Return a check that admits numbers from `low` to `high`."""

    def check(name: str, value: float | None) -> None:
        if value is not None and not low <= value <= high:
            raise InputError(f"{name} is {value}; it must be within {low} and {high}.")

    return check


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `teleoperate`."""

    task: str = option(
        "grasp", f"the task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS)
    )
    port: int = option(
        WEB_PORT,
        "port of the page on this machine's loopback, 0 for any",
        check=_within(0, 65535),
        metavar="N",
    )
    view: tuple[str, ...] = option(
        ("front", "back"),
        f"views shown, a comma list; the first leads: {', '.join(names.CAMERAS)}",
        check=many_of("view", names.CAMERAS),
        metavar="VIEW[,VIEW]",
    )
    size: int = option(448, "height and width of images [px]", check=_within(*SIZES), metavar="PX")
    frame: str = option(
        "camera",
        "whose axes the keys mean: camera (of the leading view), or tool",
        check=one_of("frame", ("camera", "tool")),
    )
    speed: float = option(
        0.5, "share of the step size that a key or a full deflection commands", check=_speed
    )
    pace: float = option(
        1.0, "share of real time; 0.5 gives twice the time to react", check=_within(*PACES)
    )
    seconds: float | None = option(
        None,
        "simulated seconds an attempt may take",
        check=_within(0.1, 3600),
        default_text=f"{SECONDS:g}, {SECONDS * len(names.SUBTASKS):g} for {names.SUTURE}",
    )
    episodes: int | None = option(
        None,
        "stop when so many more are kept",
        check=positive,
        metavar="N",
        default_text="go on until Esc",
    )
    seed: int | None = option(
        None,
        "seed of a new folder's first start",
        check=not_negative,
        metavar="N",
        default_text=f"{names.TRAIN_SEED}",
    )
    auto_keep: bool = option(False, "keep a success without asking")
    keep_failures: bool = option(False, "→ keeps an episode without success too")
    skip_idle: bool = option(
        False, "the world stands still while nothing is held, and pauses are not recorded"
    )
    out: str | None = option(
        None,
        "folder to make or to continue",
        metavar="DIR",
        default_text="outputs/teleoperation/<task>",
    )
    env: dict | None = config_only()


def run(options: Options, console: Console) -> dict[str, Any]:
    """Let a person record and say what was kept."""
    from surgicai_vision import envs
    from surgicai_vision.teleoperation.input_mapping import Steering
    from surgicai_vision.teleoperation.loop import Views, drive
    from surgicai_vision.teleoperation.pacer import Pacer
    from surgicai_vision.teleoperation.recordings import open_recordings
    from surgicai_vision.teleoperation.session import Rules, Session
    from surgicai_vision.teleoperation.web import WebView

    if not options.view:
        raise InputError("--view is empty; name at least one view.")
    config = _config(options)
    out = Path(options.out) if options.out else folders.OUTPUTS / "teleoperation" / options.task
    folders.check_folder(out, "demos.json")
    rules = Rules(options.episodes, options.auto_keep, options.keep_failures, options.skip_idle)
    with WebView(options.view, names.TASK_TEXTS[options.task], options.port) as page:
        env = envs.make(config)
        with open_recordings(out, config, env.scene.hash, options.seed) as recordings:
            session = Session(
                env, Steering(env, options.frame, options.speed), recordings, options.view, rules
            )
            views = Views(env, options.view, options.size)
            for line in page.invitation:
                console.note(line)
            drive(
                session,
                page,
                page,
                views,
                Pacer(options.pace),
                lambda status: _tell(console, status.message),
            )
            views.close()
    env.close()
    held = (
        f"{len(recordings.seeds)} demonstrations: {out}"
        if recordings.seeds
        else "no demonstrations yet."
    )
    console.say(f"{session.kept} kept, {session.discarded} discarded; {held}")
    return {
        "task": options.task,
        "kept": session.kept,
        "discarded": session.discarded,
        "skipped": session.skipped,
        "steps": session.steps_kept,
        "episodes": len(recordings.seeds),
        "demos": str(out),
    }


def _config(options: Options) -> TaskConfig:
    """Return the task's configuration with the time that a hand needs."""
    config = task_config(options.task, options.env)
    if options.env and options.env.get("max_steps"):
        if options.seconds is not None:
            raise InputError("--seconds and env: max_steps say the same; give one of them.")
        return config
    subtasks = len(names.SUBTASKS) if options.task == names.SUTURE else 1
    seconds = SECONDS * subtasks if options.seconds is None else options.seconds
    return dataclasses.replace(config, max_steps=max(1, round(seconds * names.FPS)))


def _tell(console: Console, message: str) -> None:
    """Print what became of an episode, and not what the screen shows anyway."""
    if message.startswith(("Kept", "Start", "Discarded")):
        console.note(message.split(" Move to")[0])
