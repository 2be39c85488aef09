"""`record-demos`: record demonstrations by the scripted expert or by movement primitives."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter, validators

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    EXECUTOR,
    FRACTION,
    NOT_NEGATIVE,
    SEED,
    TASK,
    EnvFields,
    default_text,
    task_config,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.percentages import interval
from surgicai_vision.core.words import plural
from surgicai_vision.demos.demonstrator import CHOOSING_DEMONSTRATORS, SOURCES
from surgicai_vision.demos.disturbance import MOST_AIM_NOISE

if TYPE_CHECKING:
    from surgicai_vision.demos.record import Learner

MILLIMETRES = Parameter(validator=validators.Number(gte=0, lte=MOST_AIM_NOISE), metavar="MM")

app = App(
    name="record-demos",
    help_epilogue="example:\n  surgicai-vision record-demos --task grasp --episodes 50",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `record-demos`.

    Attributes:
        task: The task.
        episodes: Successful episodes to keep.
        demonstrator: Who acts: expert; search (the expert without the grasp's goal); recover (the
            expert of the whole procedure, which goes back after a loss); dmp (movement primitives
            learned from --from); multiply (the demonstrations of --from, re-posed to new starts).
        from_: Demonstrations to learn from (--demonstrator dmp) or to re-pose (multiply).
        demos_used: How many demonstrations of --from to use.
        source: With --demonstrator multiply, the demonstration that an episode re-poses: the one
            with the nearest start, or a random one.
        seed: Seed of the first start; each episode takes the next.
        noise: Standard deviation of the noise on executed motions, in units of an action's range;
            labels stay the expert's.
        noise_from: Lowest standard deviation of the noise; each episode draws its own between this
            and --noise.
        jaw_noise: Standard deviation of the noise on the jaw's motion while it is not commanded to
            close.
        aim_noise: Standard deviation of how far past the grasp, along the needle, or beside the
            holes the tool aims in half of all periods of 25 control steps [mm] (grasp, handoff,
            insert); labels stay right.
        perturb_start_fraction: Share of episodes that start with an unrecorded random motion.
        upset_fraction: Share of episodes in which something goes wrong once: the needle is pushed,
            or jaws open (docs/demos.md).
        late: Most control steps by which --demonstrator recover notices a loss late; each episode
            draws its own delay.
        learner: A checkpoint, or released:NAME, that acts until a step drawn at random; labels
            stay the expert's (DAgger).
        post_success_steps: Control steps that an episode continues after its success.
        workers: Number of processes.
        out: Folder to create or continue.
    """

    task: Annotated[str, TASK] = "grasp"
    episodes: Annotated[int, COUNT] = 50
    demonstrator: str = "expert"
    from_: Annotated[Path | None, Parameter(metavar="DEMOS")] = None
    demos_used: Annotated[int | None, COUNT, default_text("1 for dmp, all for multiply")] = None
    source: Annotated[str | None, Parameter(choices=SOURCES), default_text("nearest")] = None
    seed: Annotated[int, SEED] = names.TRAIN_SEED
    noise: Annotated[float, FRACTION, Parameter(metavar="SIGMA")] = 0.0
    noise_from: Annotated[
        float | None, FRACTION, Parameter(metavar="SIGMA"), default_text("the value of --noise")
    ] = None
    jaw_noise: Annotated[float, FRACTION, Parameter(metavar="SIGMA")] = 0.0
    aim_noise: Annotated[float, MILLIMETRES] = 0.0
    perturb_start_fraction: Annotated[float, FRACTION] = 0.0
    upset_fraction: Annotated[float, FRACTION] = 0.0
    late: Annotated[int, NOT_NEGATIVE] = 0
    learner: Annotated[Path | None, DIRECTORY] = None
    post_success_steps: Annotated[int, NOT_NEGATIVE] = 0
    workers: Annotated[int, COUNT] = folders.CORES
    executor: Annotated[str, EXECUTOR] = "local"
    out: Annotated[Path | None, DIRECTORY, default_text("outputs/demos/<task>")] = None
    env: EnvFields = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Record demonstrations and print where they are."""
    from surgicai_vision.core.executor import RunContext, open_engine
    from surgicai_vision.demos.disturbance import Disturbance
    from surgicai_vision.demos.record import record
    from surgicai_vision.demos.store import MARKER, read_marker
    from surgicai_vision.evaluation.statistics import clopper_pearson

    if options.noise_from is not None and options.noise_from > options.noise:
        raise InputError(
            f"--noise-from is {options.noise_from:g}; "
            f"it must be at most --noise, {options.noise:g}."
        )
    # Wrong input is found before any work: the engine, the task, the folders.
    context = RunContext(options.workers, open_engine(options.executor), console.stage)
    config = task_config(options.task, options.env)
    out = options.out or folders.demos_folder(options.task)
    folders.check_folder(out, "demos.json")
    demos = _demos(options)
    learner = _learner(options.learner, config) if options.learner else None
    paths = record(
        config,
        episodes=options.episodes,
        out=out,
        demonstrator=options.demonstrator,
        seed=options.seed,
        disturbance=Disturbance(
            noise=options.noise,
            perturb_start_fraction=options.perturb_start_fraction,
            noise_from=options.noise_from,
            upset_fraction=options.upset_fraction,
            late=options.late,
            jaw_noise=options.jaw_noise,
            aim_noise=options.aim_noise,
        ),
        post_success_steps=options.post_success_steps,
        demos=demos,
        source=options.source or "",
        learner=learner,
        context=context,
    )
    # A start from which the demonstrator failed is in the marker and counts in the share.
    marker = read_marker(out)
    tried = len(paths) + len(marker["skipped"])
    bounds = clopper_pearson(len(paths), tried)
    console.say(f"{plural(len(paths), 'demonstration')} of {options.task}: {out}")
    console.say(
        f"{len(paths)}/{tried} starts succeeded (95 % interval {interval(bounds)})"
        + (f"; {out / MARKER} lists the others." if tried > len(paths) else ".")
    )
    upsets = marker.get("upsets", {})
    for kind, count in sorted(upsets.items()):
        console.say(f"upset '{kind}': {count['recovered']}/{count['episodes']} recovered")
    return {
        "task": options.task,
        "episodes": len(paths),
        "starts": tried,
        "share": len(paths) / tried,
        "interval": list(bounds),
        "demos": str(out),
        **({"upsets": upsets} if options.upset_fraction else {}),
    }


def _learner(folder: Path, config: TaskConfig) -> "Learner":
    """Return the learner that acts."""
    from surgicai_vision.experiments.dagger import learner_of

    return learner_of(folder, config)


def _demos(options: Options) -> list[Path]:
    """Return the demonstrations to learn from or to re-pose."""
    from surgicai_vision.demos.store import first_demos

    if options.from_ is None:
        if options.demos_used is not None:
            raise InputError(
                f"--demos-used is {options.demos_used}, but there is no --from whose "
                "demonstrations it counts; give --from DEMOS, or leave --demos-used out."
            )
        return []
    chooses = options.demonstrator in CHOOSING_DEMONSTRATORS
    return first_demos(options.from_, options.demos_used or (None if chooses else 1))
