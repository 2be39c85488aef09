"""Record demonstrations: roll an expert from seeded starts and keep the episodes that succeed.

    record(TaskConfig("grasp"), episodes=50, seed=0, out=Path("demos"), workers=2)

Seeds are taken in order from the first one; a seed at which the expert fails is written down as
skipped in `demos.json` and the next one is taken, so what is kept depends on the seeds alone. The
same command continues a run that was killed (the finished episodes lie in `<out>.work` until the
folder is complete) and does nothing when it is complete. How an episode goes is in
`surgicai_vision.demos.rollout`.
"""

import dataclasses
import functools
import importlib
import itertools
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import InputError, OutputExists, SurgicaiError, check_name
from surgicai_vision.core.executor import (
    LOCAL,
    Engine,
    Job,
    RunContext,
    building,
    job,
    run,
    work_folder,
)
from surgicai_vision.core.files import (
    check_output,
    code_version,
    read_json,
    sha256_file,
    whole_folder,
    write_json,
)
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.demos.rollout import CALM, Disturbance, Driver, roll
from surgicai_vision.demos.store import (
    MARKER,
    list_demos,
    read_demo,
    read_marker,
    write_demo,
    write_marker,
)

DEMONSTRATORS: Mapping[str, str] = MappingProxyType(
    {
        "expert": "surgicai_vision.demos.expert:Expert",
        "dmp": "surgicai_vision.demos.dmp.controller:Imitator",
        "search": "surgicai_vision.demos.search_expert:Searcher",
    }
)
"""Source → "module:class" of what acts; built as `class(env)`, or as `class(env, demos)` where it
is `LEARNING`.
"""
LEARNING = frozenset({"dmp"})
"""Sources that learn from demonstrations."""

MAX_FAILURES = 3
"""Seeds tried per episode wanted, at most; below one success in three the expert is not fit to
teach.
"""
LABELS = ("demos", "learner")
"""Arguments of a job that say where a file lies, and not what it holds."""


@dataclass(frozen=True)
class Learner:
    """The checkpoint folder of a driver, and the hash of the policy in it."""

    folder: Path
    digest: str


@functools.lru_cache(maxsize=1)
def _env(config: TaskConfig) -> Any:
    """Return this process's environment for `config`."""
    import surgicai_vision.envs as envs

    return envs.make(config)


@job("record-episode", stages=("scene", "envs", "demos"))
def record_episode(folder: Path, task: Mapping[str, Any], **how: Any) -> None:
    """Job "record-episode": roll one seed; `how` is the rest of `record_into`'s arguments."""
    record_into(folder, _env(from_mapping(TaskConfig, task)), **how)


def record_into(
    folder: Path,
    env: Any,
    demonstrator: str,
    seed: int,
    noise: float = 0.0,
    perturb_start_fraction: float = 0.0,
    noise_from: float | None = None,
    post_success_steps: int = 0,
    demos: Sequence[str] = (),
    driver: Driver | None = None,
) -> None:
    """Roll `seed` in `env` and write the episode, or why it failed, into `folder`."""
    module, _, name = DEMONSTRATORS[demonstrator].partition(":")
    actor = getattr(importlib.import_module(module), name)(env, *([demos] if demos else []))
    rollout = roll(
        env,
        actor,
        seed,
        demonstrator,
        Disturbance(noise, perturb_start_fraction, noise_from),
        post_success_steps,
        driver,
    )
    if rollout.success:
        write_demo(folder, 0, rollout.demo)
    write_json(
        folder / "result.json", {"seed": seed, "success": rollout.success, "reason": rollout.reason}
    )


def record(
    config: TaskConfig,
    *,
    episodes: int,
    out: Path,
    demonstrator: str = "expert",
    seed: int = names.TRAIN_SEED,
    disturbance: Disturbance = CALM,
    post_success_steps: int = 0,
    workers: int = 1,
    engine: Engine = LOCAL,
    demos: Sequence[Path] = (),
    learner: Learner | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Record `episodes` successful demonstrations into the folder `out`; return their files.

    Args:
        config: task and scene.
        episodes: how many to keep.
        out: folder to make; the same request continues it or finds it finished.
        demonstrator: a key of `DEMONSTRATORS`.
        seed: first seed; the following ones are taken in order.
        disturbance: noise and pushes.
        post_success_steps: control steps that an episode goes on after its success.
        workers: number of processes.
        engine: what runs them.
        demos: files of the demonstrations that a demonstrator in `LEARNING` learns from; their
            seeds are left out.
        learner: what drives until a step drawn by chance, while the labels stay the expert's.
        progress: called with (episodes kept, episodes wanted, "episodes").

    Raises:
        InputError: fewer than one episode, a negative seed or post_success_steps, an unknown
            demonstrator, demonstrations for a demonstrator that learns from none, or none for one
            that does.
        OutputExists: `out` holds something else.
        SurgicaiError: the expert failed at too many seeds.
    """
    check_name("demonstrator", demonstrator, DEMONSTRATORS)
    if episodes < 1 or min(seed, post_success_steps) < 0:
        raise InputError(
            f"episodes is {episodes}, seed {seed}, post_success_steps {post_success_steps}; they must be at least 1, 0 and 0."
        )
    _check_taught(demonstrator, demos)
    request = {
        "task": to_mapping(config),
        "demonstrator": demonstrator,
        "seed": seed,
        "episodes": episodes,
        **_of(disturbance),
    }
    if post_success_steps:
        request["post_success_steps"] = post_success_steps
    if demos:
        request["demos"] = [sha256_file(path) for path in demos]
    if learner:
        request["learner"] = learner.digest
    check_output(out, may_resume=MARKER)
    if finished(out, request):
        return list_demos(out)
    with building(out) as (store, result):
        rolling = functools.partial(run, store=store, context=RunContext(workers, engine))
        kept, skipped = _take(request, demos, learner, rolling, progress or silent)
        with whole_folder(result) as folder:
            for index, path in enumerate(kept):
                shutil.copyfile(path, folder / f"episode_{index:06d}.safetensors")
            details = {"request": request, "skipped": skipped, "episodes": episodes}
            write_marker(folder, config.task, demonstrator, code=code_version(), **details)
    return list_demos(out)


def _check_taught(demonstrator: str, demos: Sequence[Path]) -> None:
    """Refuse a demonstrator without the demonstrations it learns from, or with some that it does
    not.
    """
    if demonstrator in LEARNING and not demos:
        raise InputError(
            f"Source '{demonstrator}' learns from demonstrations; give at least one (--from DEMOS)."
        )
    if demos and demonstrator not in LEARNING:
        taught = ", ".join(sorted(LEARNING))
        raise InputError(
            f"Source '{demonstrator}' learns from no demonstrations; leave them (--from) out or take demonstrator {taught}."
        )


def _of(disturbance: Disturbance) -> dict[str, float]:
    """Return what a request says of a disturbance: nothing of what is off."""
    said = dataclasses.asdict(disturbance)
    return {name: value for name, value in said.items() if value != getattr(CALM, name)}


def finished(out: Path, request: Mapping[str, Any]) -> bool:
    """Say whether `out` is the finished result of `request`; `OutputExists` if it is that of
    another one.
    """
    if not (out / MARKER).exists():
        return False
    if read_marker(out).get("request") != request:
        raise OutputExists(
            f"--out {out} holds demonstrations of another command (see {out / MARKER}); give another folder."
        )
    # Left by a run that was killed after its last step.
    shutil.rmtree(work_folder(out), ignore_errors=True)
    return True


def _take(
    request: Mapping[str, Any],
    demos: Sequence[Path],
    learner: Learner | None,
    rolling: Callable[..., list[Path]],
    progress: Progress,
) -> tuple[list[Path], list[dict[str, Any]]]:
    """Try seeds in order until enough succeeded; return the kept files and the skipped seeds."""
    kept: list[Path] = []
    skipped: list[dict[str, Any]] = []
    wanted, inputs = request["episodes"], tuple(request.get("demos", ()))
    same = {
        key: value
        for key, value in request.items()
        if key not in ("seed", "episodes", "demos", "learner")
    }
    if demos:
        same["demos"] = [str(path.resolve()) for path in demos]
    if learner:
        same["learner"], inputs = str(learner.folder.resolve()), (*inputs, learner.digest)
    known = {read_demo(path).seed for path in demos}
    seeds = (seed for seed in itertools.count(request["seed"]) if seed not in known)
    while len(kept) < wanted:
        if len(kept) + len(skipped) >= MAX_FAILURES * wanted + 5:
            reasons = "; ".join(f"seed {row['seed']}: {row['reason']}" for row in skipped[:3])
            raise SurgicaiError(
                f"The {request['demonstrator']} succeeded at {len(kept)} of {len(kept) + len(skipped)} starts of "
                f"{request['task']['task']}; {wanted} were wanted ({reasons}; …)."
            )
        jobs = [
            Job(
                "drive-episode" if learner else "record-episode",
                {**same, "seed": seed},
                inputs,
                label=LABELS,
            )
            for seed in itertools.islice(seeds, wanted - len(kept))
        ]
        report = functools.partial(_report, progress, len(kept), wanted)
        for folder in rolling(jobs, progress=report):
            result = read_json(folder / "result.json")
            if result["success"]:
                kept.append(folder / "episode_000000.safetensors")
            else:
                skipped.append({"seed": result["seed"], "reason": result["reason"]})
        progress(len(kept), wanted, "episodes")
    return kept, skipped


def _report(
    progress: Progress, before: int, wanted: int, done: int, total: int, unit: str = ""
) -> None:
    """Pass on the progress of one wave of seeds as that of the whole."""
    progress(before + done, wanted, "episodes")


def check_folder(folder: Path) -> int:
    """Read every episode of `folder`; return their number, `BadFile` at the first damaged one."""
    paths = list_demos(folder)
    for path in paths:
        read_demo(path)
    return len(paths)
