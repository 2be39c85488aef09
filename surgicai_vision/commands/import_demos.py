"""`import-demos`: read SurgicAI's recordings, ROS bags, LeRobot datasets and logs of drive."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY, FILE_ONLY, SUBTASK, EnvFields, default_text
from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError, check_name
from surgicai_vision.core.words import plural
from surgicai_vision.demos.imports.rosbag.config import (
    CONVENTIONS,
    SEGMENTATIONS,
    BagConfig,
    Topics,
    bags_in,
    is_bag,
)

if TYPE_CHECKING:
    from surgicai_vision.demos.imports.rosbag.importer import BagSummary

ROLES = tuple(role.name for role in dataclasses.fields(Topics))
DRIVE_LOG = ".jsonl"
app = App(
    name="import-demos",
    help_epilogue=f"""\
example:
  surgicai-vision import-demos regrasp_all_episodes_merged.pkl --task handoff \\
      --out outputs/demos/surgicai

A bag is a .bag, .db3 or .mcap file, or a ROS 2 folder; a folder of bags is read whole:
  surgicai-vision import-demos trial.bag --topic needle=/needle/pose --out outputs/demos/trial
A LeRobot dataset (v2.1 or v3) of both arms' poses, as in Open-H-Embodiment and SutureBot:
  surgicai-vision import-demos datasets/suturing --out outputs/demos/suturing
What a policy did on a robot, as logged by robot drive:
  surgicai-vision import-demos outputs/drive/TASK-POLICY/drive.jsonl --out outputs/demos/driven
Roles of --topic: {", ".join(ROLES)}.
Without --task, every subtask that is found gets a folder below --out. Frames, units, labels and
more are set in the table `bag` of a --config file, the scene in the table `env` (docs/demos.md).\
""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `import-demos`.

    Attributes:
        file: A pickle as SurgicAI writes it, an npz of its arrays, a ROS bag, a folder of bags,
            the folder of a LeRobot dataset, or the log of `robot drive`.
        task: The subtask that the file shows; required for a pickle or an npz, which do not say.
        out: Folder to create.
        topic: Topics of a bag that differ from those of --convention.
        convention: Whose topic names a bag uses.
        segmentation: How to cut a bag or a dataset into subtasks.
    """

    file: Annotated[Path, Parameter(metavar="FILE")] = field(kw_only=False)
    task: Annotated[
        str | None, SUBTASK, default_text("for a bag, a dataset or a log, every subtask found")
    ] = None
    out: Annotated[
        Path | None,
        DIRECTORY,
        default_text("surgicai-<task>, bag, dataset-<name> or drive in outputs/demos"),
    ] = None
    topic: Annotated[
        tuple[str, ...], Parameter(metavar="ROLE=/TOPIC[,ROLE=/TOPIC]", show_default=False)
    ] = ()
    convention: Annotated[
        str | None, Parameter(choices=tuple(CONVENTIONS)), default_text("dvrk")
    ] = None
    segmentation: Annotated[
        str | None, Parameter(choices=tuple(SEGMENTATIONS)), default_text("auto")
    ] = None
    bag: Annotated[BagConfig | None, FILE_ONLY] = None
    env: EnvFields = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Import demonstrations and print where they are."""
    path = options.file
    if (path / names.INFO_FILE).is_file():
        return _import_dataset(path, options, console)
    if path.suffix == DRIVE_LOG:
        return _import_drive_log(path, options, console)
    if is_bag(path) or path.is_dir():
        return _import_bags(path, options, console)
    for_bags = {
        "--topic": options.topic,
        "--convention": options.convention,
        "--segmentation": options.segmentation,
        "the table bag": options.bag,
        "the table env": options.env,
    }
    given = [name for name, value in for_bags.items() if value]
    if given:
        raise InputError(
            f"{given[0]} is for bags, and {path} is not one (*.bag, *.db3, *.mcap, a ROS 2 folder)."
        )
    return _import_surgicai(path, options, console)


def _import_surgicai(path: Path, options: Options, console: Console) -> dict[str, object]:
    from surgicai_vision.demos.imports.surgicai import import_demos

    if options.task is None:
        raise InputError(
            "import-demos needs --task: the file does not name its task; give one of "
            f"{', '.join(names.SUBTASKS)}."
        )
    out = options.out or folders.demos_folder(f"surgicai-{options.task}")
    folders.check_folder(out, "demos.json")
    with console.stage(f"importing {options.task}", "episodes") as progress:
        summary = import_demos(path, task=options.task, out=out, progress=progress)
    console.say(
        f"{plural(len(summary.paths), 'demonstration')} of {options.task}, "
        f"{plural(summary.steps, 'step')}: {out}"
    )
    if summary.skipped:
        console.say(
            f"{plural(len(summary.skipped), 'episode')} could not be replayed; "
            f"{out}/demos.json says why."
        )
    return {
        "task": options.task,
        "episodes": len(summary.paths),
        "steps": summary.steps,
        "step": summary.step,
        "skipped": len(summary.skipped),
        "demos": str(out),
    }


def _import_dataset(path: Path, options: Options, console: Console) -> dict[str, object]:
    from surgicai_vision.demos.imports.lerobot_dataset import import_dataset

    _refuse_topics(
        options,
        "a LeRobot dataset; frames, labels and more are set in the table bag of a --config file",
    )
    out = options.out or folders.demos_folder(f"dataset-{path.resolve().name}")
    return _import_arms(import_dataset, options, out, "frames", console)


def _import_drive_log(path: Path, options: Options, console: Console) -> dict[str, object]:
    from surgicai_vision.demos.imports.drive_log import import_drive_log

    _refuse_topics(options, "a log of robot drive")
    out = options.out or folders.demos_folder("drive")
    return _import_arms(import_drive_log, options, out, "demonstrations", console)


def _refuse_topics(options: Options, what: str) -> None:
    """Refuse options that are only for bags; `what` says what is imported instead."""
    if options.topic or options.convention:
        raise InputError(f"--topic and --convention are for bags, and {options.file} is {what}.")


def _import_arms(
    read: "Callable[..., Sequence[BagSummary]]",
    options: Options,
    out: Path,
    unit: str,
    console: Console,
) -> dict[str, object]:
    """Import a file of both arms' poses, without images of ours, with the reader `read`."""
    path = options.file
    with console.stage(f"importing {path.name}", unit) as progress:
        summaries = read(
            path,
            task=options.task,
            out=out,
            config=_config(options),
            env=options.env,
            progress=progress,
        )
    return {"tasks": _told(summaries, console)}


def _import_bags(path: Path, options: Options, console: Console) -> dict[str, object]:
    from surgicai_vision.demos.imports.rosbag.importer import import_bags

    bags = bags_in(path)
    if not bags:
        raise BadFile(
            f"Cannot read {path}: it is a folder without bags (*.bag, *.db3, *.mcap, folders of "
            "ROS 2)."
        )
    out = options.out or folders.demos_folder("bag")
    with console.stage(f"importing {path.name}", "bags") as progress:
        summaries = import_bags(
            bags,
            task=options.task,
            out=out,
            config=_config(options),
            env=options.env,
            progress=progress,
        )
    return {"bags": len(bags), "tasks": _told(summaries, console)}


def _told(summaries: "Sequence[BagSummary]", console: Console) -> dict[str, dict[str, object]]:
    """Print what an import made, and return it by task."""
    rows: dict[str, dict[str, object]] = {}
    for made in summaries:
        kept = len(made.paths)
        console.say(
            f"{plural(kept, 'demonstration')} of {made.task}, {plural(made.steps, 'step')}; "
            f"{made.succeeded} of {kept} end in success by our tolerances: {made.out}"
        )
        if made.skipped:
            console.say(
                f"{plural(len(made.skipped), 'part')} could not be replayed; "
                f"{made.out}/demos.json says why."
            )
        if made.clipped:
            console.say(
                f"{made.clipped} steps are faster than step preset '{made.step}' and were clipped."
            )
        rows[made.task] = {
            "episodes": kept,
            "steps": made.steps,
            "step": made.step,
            "clipped": made.clipped,
            "pauses": made.pauses,
            "succeeded": made.succeeded,
            "skipped": len(made.skipped),
            "demos": str(made.out),
        }
    return rows


def _config(options: Options) -> BagConfig:
    """Return the table `bag`, overridden by the options of the command line."""
    config = options.bag or BagConfig()
    return dataclasses.replace(
        config,
        topics=dataclasses.replace(config.topics, **_topics(options.topic)),
        convention=options.convention or config.convention,
        segmentation=options.segmentation or config.segmentation,
    )


def _topics(given: Sequence[str]) -> dict[str, str]:
    """Return role → topic of the texts "role=topic"."""
    topics = {}
    for text in given:
        role, equals, topic = text.partition("=")
        if not equals:
            raise InputError(
                f"--topic is '{text}'; write ROLE=/TOPIC, with ROLE one of {', '.join(ROLES)}."
            )
        topics[check_name("role", role, ROLES)] = topic
    return topics
