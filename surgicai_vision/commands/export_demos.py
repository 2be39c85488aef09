"""`export-demos`: turn demonstrations into transitions for reinforcement-learning libraries."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import COUNT, DIRECTORY, TASK, EnvFields, default_text
from surgicai_vision.core.config import TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.words import plural

app = App(
    name="export-demos",
    help_epilogue="""\
example:
  surgicai-vision export-demos --task grasp --format d3rlpy""",
)
FORMATS = ("npz", "sb3", "d3rlpy", "minari", "robomimic")
OBS_TYPES = ("relative", "state", "goal")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `export-demos`.

    Attributes:
        task: The task, which must be that of given demonstrations.
        demos: Folder of demonstrations.
        obs_type: What the transitions observe; goal allows hindsight relabelling.
        format: File format: npz, or that of Stable-Baselines3, d3rlpy, Minari or robomimic.
        episodes: Take only the first N demonstrations.
        env: Fields of the env to change from the recorded ones, such as reward.
        out: Folder to create.
    """

    task: Annotated[str | None, TASK, default_text("the demonstrations', else grasp")] = None
    demos: Annotated[Path | None, DIRECTORY, default_text("outputs/demos/<task>")] = None
    obs_type: Annotated[str, Parameter(choices=OBS_TYPES)] = "relative"
    format: Annotated[str, Parameter(choices=FORMATS)] = "npz"
    episodes: Annotated[int | None, COUNT, default_text("all")] = None
    env: EnvFields = None
    out: Annotated[
        Path | None,
        DIRECTORY,
        default_text("outputs/transitions/<task>-<obs-type>-<format>"),
    ] = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Replay the demonstrations and write their transitions."""
    from surgicai_vision.demos.store import first_demos, read_demo
    from surgicai_vision.rl import export
    from surgicai_vision.rl.extra import check_extra
    from surgicai_vision.rl.transitions import of_demos

    check_extra(f"--format {options.format}", *export.PACKAGES[options.format])
    if options.format == "d3rlpy" and options.obs_type == "goal":
        raise InputError("d3rlpy takes no goal dicts; give --obs-type relative or state.")
    demos = options.demos or folders.demos_folder(options.task or "grasp")
    paths = first_demos(demos, options.episodes)
    recorded = read_demo(paths[0]).config
    folders.check_task(options.task, recorded.task, demos)
    name = f"{recorded.task}-{options.obs_type}-{options.format}"
    out = options.out or folders.OUTPUTS / "transitions" / name
    folders.check_folder(out, export.CARD, ours=export.FILES.values())
    config = from_mapping(TaskConfig, {**to_mapping(recorded), **(options.env or {})}, "env")
    with console.stage("transitions", "demonstrations") as progress:
        transitions = of_demos(paths, config, options.obs_type, progress)
    written = export.write(transitions, options.format, out)
    left_out = f", {transitions.failed} left out" if transitions.failed else ""
    console.say(
        f"{plural(len(transitions), 'transition')} of {plural(transitions.episodes, 'episode')}"
        f"{left_out}: {written}"
    )
    return {
        "transitions": len(transitions),
        "episodes": transitions.episodes,
        "failed": transitions.failed,
        "out": str(written),
    }
