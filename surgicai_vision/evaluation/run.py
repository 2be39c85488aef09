"""Run: evaluate a policy and keep everything in a folder."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from surgicai_vision.core.config import SceneConfig, digest, to_mapping
from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.progress import Progress, Stage
from surgicai_vision.evaluation.films import Filming
from surgicai_vision.evaluation.finished import FOLDER, FinishedEpisodes
from surgicai_vision.evaluation.policy_spec import PolicySpec
from surgicai_vision.evaluation.provenance import command_line, episode_code, provenance
from surgicai_vision.evaluation.rollout import check_seeds, evaluate
from surgicai_vision.evaluation.storage import (
    MARKER,
    Row,
    alone_in,
    find_evaluations,
    read_evaluation,
    write_evaluation,
)
from surgicai_vision.scene import build_scene
from surgicai_vision.training.run_config import Starts


def check_scene(out: Path, scene: SceneConfig, what: str) -> None:
    """Refuse a folder with evaluations in another scene, which cannot be paired with new ones.

    Args:
        out: folder that holds evaluations, or is to hold some.
        scene: of the new evaluations.
        what: what the folder's evaluations are, for the message.

    Raises:
        OutputExists: an evaluation in `out` was made in another scene.
    """
    present = build_scene(scene).hash
    for folder in find_evaluations(out):
        made_in = read_evaluation(folder).about.get("scene_hash")
        if made_in not in (None, present):
            raise OutputExists(
                f"{out} holds {what} of scene {made_in[:12]}, and the present scene is "
                f"{present[:12]}; give another --out."
            )


def evaluate_once(
    out: Path,
    open_spec: Callable[[], PolicySpec],
    seeds: Sequence[int],
    stage: Stage,
    workers: int | None,
) -> Row:
    """Evaluate into the folder `out` if it holds no evaluation yet; return the summary."""
    if (out / MARKER).exists():
        return read_evaluation(out).summary
    spec = open_spec()
    with stage(f"evaluation: {spec.name}", "steps") as progress:
        return evaluate_into(out, spec, seeds, workers, progress)


def evaluate_into(
    out: Path,
    spec: PolicySpec,
    seeds: Sequence[int],
    workers: int | None = None,
    progress: Progress | None = None,
    filming: Filming | None = None,
) -> Row:
    """Evaluate, store everything in the folder `out` and return the summary.

    Episodes that a killed evaluation of the same policy, code and starts has finished there are not
    run again.

    Args:
        out: folder for rows, films and summary.
        spec: what is evaluated.
        seeds: consecutive start seeds.
        workers: processes.
        progress: called as progress(steps done, most steps there can be).
        filming: which episodes become videos; None films nothing.

    Raises:
        InputError: another process evaluates into `out`.
    """
    check_seeds(seeds)
    run = dataclasses.replace(spec.run, starts=Starts(int(seeds[0]), len(seeds)))
    scene_hash = build_scene(spec.config.scene).hash
    with alone_in(out):
        finished = None
        if spec.resumes:
            # The call that continues an evaluation may have other options.
            told = {key: value for key, value in spec.about.items() if key != "command"}
            owner = [to_mapping(run), told, scene_hash, episode_code(), repr(filming)]
            finished = FinishedEpisodes(out / FOLDER, digest(owner))
        episodes = evaluate(
            spec.make_agent,
            spec.config,
            seeds,
            workers=workers,
            progress=progress,
            filming=filming,
            upset=spec.run.upset,
            finished=finished,
        )
        about = {
            "command": command_line(),
            "provenance": provenance(),
            "scene_hash": scene_hash,
            **spec.about,
        }
        result = write_evaluation(out, episodes, run, about)
        if finished:
            finished.remove()
        return result
