"""Record demonstrations: run a demonstrator from seeded starts and keep what succeeds.

    record(TaskConfig("grasp"), episodes=50, seed=0, out=Path("demos"))

Seeds are used in order from the first one. A seed at which the demonstrator fails is listed as
skipped in `demos.json` and the next one is used, so what is kept depends only on the seeds. The
same command continues a run that was killed (the finished episodes are in `<out>.work` until the
folder is complete) and does nothing when it is complete. `surgicai_vision.demos.rollout` runs one
episode.
"""

import dataclasses
import functools
import itertools
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgicai_vision.core import names
from surgicai_vision.core.banks import check_training_starts
from surgicai_vision.core.config import JSON, TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import (
    InputError,
    OutputExists,
    PhysicsError,
    SurgicaiError,
    check_name,
)
from surgicai_vision.core.executor import Job, RunContext, building, job, run, work_folder
from surgicai_vision.core.files import (
    check_output,
    read_json,
    sha256_file,
    whole_folder,
    write_json,
)
from surgicai_vision.core.progress import Progress
from surgicai_vision.demos.demonstrator import (
    CHOOSING_DEMONSTRATORS,
    DEMONSTRATORS,
    LEARNING_DEMONSTRATORS,
    PERSISTING_DEMONSTRATORS,
    BehaviourPolicy,
    make_demonstrator,
)
from surgicai_vision.demos.disturbance import (
    UNDISTURBED,
    Disturbance,
    check_aim,
    check_late,
    check_returning,
    check_told,
)
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.store import (
    MARKER,
    is_same_request,
    list_demos,
    read_demo,
    read_marker,
    write_demo,
    write_marker,
)
from surgicai_vision.envs.upset import check_upset_task

if TYPE_CHECKING:
    from surgicai_vision.envs.base import SuturingEnv

MAX_FAILURES = 3
"""Most seeds tried per requested episode: one success in three is the lowest usable rate."""
LABELS = ("demos", "learner")
"""Arguments of a job that give a file's location, not its content; the job's key omits them."""


@dataclass(frozen=True)
class Learner:
    """A policy that acts instead of the demonstrator at first.

    Attributes:
        folder: its checkpoint folder.
        digest: hash of the policy in it.
    """

    folder: Path
    digest: str


@functools.lru_cache(maxsize=1)
def _env(config: TaskConfig) -> "SuturingEnv":
    """Return this process's environment for `config`."""
    from surgicai_vision import envs  # mujoco, which listing the demonstrators does not need

    return envs.make(config)


@job("record-episode", stages=("scene", "envs", "demos"))
def record_episode(folder: Path, task: Mapping[str, JSON], **arguments: Any) -> None:
    """Run one seed; `arguments` are the remaining ones of `record_into`."""
    record_into(folder, _env(from_mapping(TaskConfig, task)), **arguments)


def record_into(
    folder: Path,
    env: "SuturingEnv",
    demonstrator: str,
    seed: int,
    noise: float = 0.0,
    perturb_start_fraction: float = 0.0,
    noise_from: float | None = None,
    upset_fraction: float = 0.0,
    late: int = 0,
    jaw_noise: float = 0.0,
    aim_noise: float = 0.0,
    post_success_steps: int = 0,
    demos: Sequence[str] = (),
    source: str = "",
    behaviour: BehaviourPolicy | None = None,
) -> None:
    """Run `seed` in `env` and write the episode, or why it failed, into `folder`."""
    try:
        result = rollout(
            env,
            make_demonstrator(demonstrator, env, demos, source),
            seed,
            demonstrator,
            Disturbance(
                noise=noise,
                perturb_start_fraction=perturb_start_fraction,
                noise_from=noise_from,
                upset_fraction=upset_fraction,
                late=late,
                jaw_noise=jaw_noise,
                aim_noise=aim_noise,
            ),
            post_success_steps,
            behaviour,
        )
    except PhysicsError as error:  # another try would meet the same start
        failed = {"seed": seed, "success": False, "reason": str(error)}
        write_json(folder / "result.json", failed | ({"upset": ""} if upset_fraction else {}))
        return
    if result.success:
        write_demo(folder, 0, result.demo)
    told = {"seed": seed, "success": result.success, "reason": result.reason}
    if result.demo.source:
        told["source"] = result.demo.source
    write_json(folder / "result.json", told | ({"upset": result.upset} if upset_fraction else {}))


def record(
    config: TaskConfig,
    *,
    episodes: int,
    out: Path,
    demonstrator: str = "expert",
    seed: int = names.TRAIN_SEED,
    disturbance: Disturbance = UNDISTURBED,
    post_success_steps: int = 0,
    demos: Sequence[Path] = (),
    source: str = "",
    learner: Learner | None = None,
    context: RunContext = RunContext(),
) -> list[Path]:
    """Record `episodes` successful demonstrations into the folder `out`; return their files.

    Args:
        config: task and scene.
        episodes: how many to keep.
        out: folder to create; repeating the same request continues or reuses it.
        demonstrator: a key of `DEMONSTRATORS`.
        seed: first seed; the following ones are used in order, all of them training starts.
        disturbance: noise, perturbed starts and upsets.
        post_success_steps: control steps recorded after an episode's success.
        demos: files of the demonstrations that a demonstrator in `LEARNING_DEMONSTRATORS` learns
            from; their seeds are left out.
        source: how a demonstrator in `CHOOSING_DEMONSTRATORS` takes one of them per episode; "" for
            its default.
        learner: acts until a randomly drawn step; the labels remain the demonstrator's.
        context: workers, engine and display.

    Raises:
        InputError: fewer than one episode, a negative seed or post_success_steps, starts that
            are reserved for validation or tests, an unknown demonstrator, demonstrations for a
            demonstrator that does not learn from any, none for one that does, a source for one
            that chooses no demonstration, upsets in a task that has none, `aim_noise` where nothing
            is grasped or by a demonstrator that cannot miss, held actions (`action_repeat`) in
            demonstrations that go on after their success, or a whole procedure that goes on only
            when told to.
        OutputExists: `out` holds something else.
        SurgicaiError: the demonstrator failed at too many seeds.
    """
    check_name("demonstrator", demonstrator, DEMONSTRATORS)
    if episodes < 1 or min(seed, post_success_steps) < 0:
        raise InputError(
            f"episodes is {episodes}, seed {seed}, post_success_steps {post_success_steps}; "
            "they must be at least 1, 0 and 0."
        )
    check_training_starts(seed, episodes)
    _check_demos(demonstrator, demos, source)
    check_late(demonstrator, disturbance)
    check_aim(demonstrator, config.task, disturbance)
    check_returning(demonstrator, config)
    _check_held(config, demonstrator, post_success_steps)
    if learner is None:
        check_told(config, f"demonstrator '{demonstrator}'")
    if disturbance.upset_fraction:
        check_upset_task(config.task)
    # What determines the result: a finished folder of the same request is left as it is. Unused
    # options are omitted, so that a folder still matches its request when an option is added.
    request = {
        "task": to_mapping(config),
        "demonstrator": demonstrator,
        "seed": seed,
        "episodes": episodes,
        **_disturbance_fields(disturbance),
    }
    options = {
        "post_success_steps": post_success_steps,
        "demos": [sha256_file(path) for path in demos],
        "source": source,
        "learner": learner.digest if learner else "",
    }
    request |= {name: value for name, value in options.items() if value}
    check_output(out, may_resume=MARKER)
    if finished(out, request):
        return list_demos(out)
    title = f"demos: {episodes} of {config.task}"
    with building(out) as (store, result), context.stage(title, "episodes") as progress:
        run_jobs = functools.partial(run, store=store, context=context)
        kept, skipped, upsets = _run_seeds(request, demos, learner, run_jobs, progress)
        with whole_folder(result) as folder:
            for index, path in enumerate(kept):
                shutil.copyfile(path, folder / f"episode_{index:06d}.safetensors")
            details = {"request": request, "skipped": skipped, "episodes": episodes}
            if disturbance.upset_fraction:
                details["upsets"] = upsets
            details |= _sources(kept)
            write_marker(folder, config.task, demonstrator, **details)
    return list_demos(out)


def _sources(kept: Sequence[Path]) -> dict[str, list[str]]:
    """Return the sha256 of each kept episode's source demonstration, if the episodes have one."""
    results = [read_json(path.parent / "result.json") for path in kept]
    return {"sources": [row["source"] for row in results]} if "source" in results[0] else {}


def _check_held(config: TaskConfig, demonstrator: str, post_success_steps: int) -> None:
    """Refuse held actions in demonstrations that go on after their success.

    An env holds no action beyond a success, so that the steps after it would be shorter than those
    before, and a dataset's timestamps wrong.
    """
    goes_on = post_success_steps > 0 or demonstrator in PERSISTING_DEMONSTRATORS
    if config.action_repeat > 1 and goes_on:
        raise InputError(
            f"action_repeat is {config.action_repeat}, and demonstrations of '{demonstrator}' with "
            f"post_success_steps {post_success_steps} go on after their success; record them with "
            "action_repeat 1 ('export-demos' can hold their actions)."
        )


def _check_demos(demonstrator: str, demos: Sequence[Path], source: str) -> None:
    """Refuse a learning demonstrator without demonstrations, others with some, an unused source."""
    if demonstrator in LEARNING_DEMONSTRATORS and not demos:
        raise InputError(
            f"Demonstrator '{demonstrator}' learns from demonstrations; "
            "give at least one (--from DEMOS)."
        )
    if demos and demonstrator not in LEARNING_DEMONSTRATORS:
        learning = ", ".join(sorted(LEARNING_DEMONSTRATORS))
        raise InputError(
            f"Demonstrator '{demonstrator}' does not learn from demonstrations; leave them "
            f"(--from) out or use demonstrator {learning}."
        )
    if source and demonstrator not in CHOOSING_DEMONSTRATORS:
        choosing = ", ".join(sorted(CHOOSING_DEMONSTRATORS))
        raise InputError(
            f"source is '{source}', but demonstrator '{demonstrator}' does not choose a "
            f"demonstration; leave source out or use demonstrator {choosing}."
        )


def _disturbance_fields(disturbance: Disturbance) -> dict[str, float]:
    """Return the fields in which a disturbance differs from `UNDISTURBED`, for a request."""
    undisturbed = dataclasses.asdict(UNDISTURBED)
    fields = dataclasses.asdict(disturbance)
    return {name: value for name, value in fields.items() if value != undisturbed[name]}


def finished(out: Path, request: Mapping[str, object]) -> bool:
    """Return True if `out` is the finished result of `request`.

    Raises:
        OutputExists: it is the result of another request.
    """
    if not (out / MARKER).exists():
        return False
    if not is_same_request(read_marker(out).get("request"), request):
        raise OutputExists(
            f"--out {out} holds demonstrations of another command (see {out / MARKER}); "
            "give another folder."
        )
    # Left by a run that was killed after its last step.
    shutil.rmtree(work_folder(out), ignore_errors=True)
    return True


def _run_seeds(
    request: Mapping[str, Any],
    demos: Sequence[Path],
    learner: Learner | None,
    run_jobs: Callable[..., list[Path]],
    progress: Progress,
) -> tuple[list[Path], list[dict[str, Any]], dict[str, dict[str, int]]]:
    """Try seeds in order until enough have succeeded.

    Returns:
        The kept files; the skipped seeds; and for each kind of upset how many episodes had it
        (`episodes`) and how many of them succeeded (`recovered`).
    """
    kept: list[Path] = []
    skipped: list[dict[str, Any]] = []
    upsets: dict[str, dict[str, int]] = {}
    wanted = request["episodes"]
    inputs = tuple(request.get("demos", ()))
    shared = {
        key: value
        for key, value in request.items()
        if key not in ("seed", "episodes", "demos", "learner")
    }
    if demos:
        shared["demos"] = [str(path.resolve()) for path in demos]
    if learner:
        shared["learner"] = str(learner.folder.resolve())
        inputs = (*inputs, learner.digest)
    # The next seeds, without those of the demonstrations used for learning.
    known = {read_demo(path).seed for path in demos}
    bank = range(request["seed"], names.VALIDATION_SEED)
    seeds = (seed for seed in bank if seed not in known)
    while len(kept) < wanted:
        if len(kept) + len(skipped) >= MAX_FAILURES * wanted + 5:
            reasons = "; ".join(f"seed {row['seed']}: {row['reason']}" for row in skipped[:3])
            raise SurgicaiError(
                f"The {request['demonstrator']} succeeded at {len(kept)} of "
                f"{len(kept) + len(skipped)} starts of {request['task']['task']}; {wanted} were "
                f"requested ({reasons}; …)."
            )
        # As many seeds as there are missing episodes; failed ones are replaced in the next round.
        jobs = [
            Job(
                "drive-episode" if learner else "record-episode",
                {**shared, "seed": seed},
                inputs,
                label=LABELS,
            )
            for seed in itertools.islice(seeds, wanted - len(kept))
        ]
        if not jobs:
            raise SurgicaiError(
                f"The training starts end at {names.VALIDATION_SEED - 1}, and "
                f"{len(kept)} of {wanted} demonstrations succeeded; give a smaller --seed."
            )
        report = functools.partial(_report_all, progress, len(kept), wanted)
        for folder in run_jobs(jobs, progress=report):
            result = read_json(folder / "result.json")
            if result["success"]:
                kept.append(folder / "episode_000000.safetensors")
            else:
                skipped.append({key: result[key] for key in result if key != "success"})
            if kind := result.get("upset"):
                count = upsets.setdefault(kind, {"episodes": 0, "recovered": 0})
                count["episodes"] += 1
                count["recovered"] += result["success"]
        progress(len(kept), wanted, "episodes")
    return kept, skipped, upsets


def _report_all(
    progress: Progress, before: int, wanted: int, done: int, total: int, unit: str = ""
) -> None:
    """Report the progress of one batch of seeds as progress of the whole recording."""
    progress(before + done, wanted, "episodes")


def check_folder(folder: Path) -> int:
    """Read every episode of `folder` and return their number.

    Raises:
        BadFile: a damaged episode.
    """
    paths = list_demos(folder)
    for path in paths:
        read_demo(path)
    return len(paths)
