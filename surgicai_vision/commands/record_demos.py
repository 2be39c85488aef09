"""`record-demos`: record demonstrations by the scripted expert, or by movement primitives learned
from some.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    config_only,
    executor_option,
    not_negative,
    one_of,
    option,
    positive,
    share,
    task_config,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError

EXAMPLE = "surgicai-vision record-demos --task grasp --episodes 50"


@dataclass(frozen=True)
class Options:
    """Options of `record-demos`."""

    task: str = option(
        "grasp", f"the task: {', '.join(names.TASKS)}", check=one_of("task", names.TASKS)
    )
    episodes: int = option(50, "successful episodes to keep", check=positive, metavar="N")
    demonstrator: str = option(
        "expert",
        "who acts: expert; search: the expert without the grasp's goal; dmp: movement primitives learned from --from",
    )
    from_: str | None = option(
        None, "demonstrations to learn from (--demonstrator dmp)", metavar="DEMOS"
    )
    demos_used: int = option(1, "how many of them to learn from", check=positive, metavar="N")
    seed: int = option(
        names.TRAIN_SEED, "seed of the first start; each episode takes the next", check=not_negative
    )
    noise: float = option(
        0.0,
        "standard deviation of the noise on executed motions, in units of an action's range; labels stay the expert's",
        check=share,
        metavar="SIGMA",
    )
    noise_from: float | None = option(
        None,
        "lowest such deviation: each episode draws its own between this and --noise",
        check=share,
        metavar="SIGMA",
        default_text="--noise itself",
    )
    perturb_start_fraction: float = option(
        0.0,
        "share of episodes that start with a push that is not recorded",
        check=share,
        metavar="P",
    )
    learner: str | None = option(
        None,
        "a checkpoint that acts until a step drawn by chance; labels stay the expert's (DAgger)",
        metavar="DIR",
    )
    post_success_steps: int = option(
        0,
        "control steps that an episode goes on after its success",
        check=not_negative,
        metavar="N",
    )
    workers: int = option(folders.CORES, "processes", check=positive, metavar="N")
    executor: str = executor_option()
    out: str | None = option(
        None, "folder to make or to continue", metavar="DIR", default_text="outputs/demos/<task>"
    )
    env: dict | None = config_only()


def run(options: Options, console: Console) -> dict[str, Any]:
    """Record and say where the demonstrations are."""
    from surgicai_vision.core.executor import open_engine
    from surgicai_vision.demos.record import record
    from surgicai_vision.demos.rollout import Disturbance
    from surgicai_vision.demos.store import MARKER, read_marker
    from surgicai_vision.evaluation.statistics import clopper_pearson

    if options.noise_from is not None and options.noise_from > options.noise:
        raise InputError(
            f"--noise-from is {options.noise_from:g}; it must be at most --noise, {options.noise:g}."
        )
    engine = open_engine(options.executor)
    config = task_config(options.task, options.env)
    out = Path(options.out) if options.out else folders.demos_folder(options.task)
    folders.check_folder(out, "demos.json")
    taught = _taught(Path(options.from_), options.demos_used) if options.from_ else []
    learner = _learner(Path(options.learner), config) if options.learner else None
    with console.stage(f"recording {options.task}", "episodes") as progress:
        paths = record(
            config,
            episodes=options.episodes,
            out=out,
            demonstrator=options.demonstrator,
            seed=options.seed,
            disturbance=Disturbance(
                options.noise, options.perturb_start_fraction, options.noise_from
            ),
            post_success_steps=options.post_success_steps,
            workers=options.workers,
            engine=engine,
            demos=taught,
            learner=learner,
            progress=progress,
        )
    tried = len(paths) + len(read_marker(out)["skipped"])
    low, high = clopper_pearson(len(paths), tried)
    console.say(f"{len(paths)} demonstrations of {options.task}: {out}")
    console.say(
        f"{len(paths)}/{tried} starts succeeded (95 % interval {low:.0%} to {high:.0%})"
        + (f"; {out / MARKER} names the others." if tried > len(paths) else ".")
    )
    return {
        "task": options.task,
        "episodes": len(paths),
        "starts": tried,
        "share": len(paths) / tried,
        "interval": [low, high],
        "demos": str(out),
    }


def _learner(folder: Path, config: TaskConfig) -> Any:
    """Return the learner that drives."""
    from surgicai_vision.experiments.dagger import learner_of

    return learner_of(folder, config)


def _taught(folder: Path, count: int) -> list[Path]:
    """Return the first `count` demonstrations of a folder."""
    from surgicai_vision.demos.store import list_demos

    paths = list_demos(folder)
    if count > len(paths):
        raise InputError(f"--demos-used is {count}; {folder} holds {len(paths)}.")
    return paths[:count]
