"""Run: evaluate a policy and keep everything in a folder."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from surgicai_vision.core import files
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.progress import Stage
from surgicai_vision.evaluation.policy_spec import Subject
from surgicai_vision.evaluation.provenance import command_line, provenance
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.storage import MARKER, write_evaluation


def evaluate_once(
    out: Path,
    make_subject: Callable[[], Subject],
    seeds: Sequence[int],
    stage: Stage,
    workers: int | None,
) -> dict[str, Any]:
    """Evaluate into the folder `out` if it holds no evaluation yet; return the summary."""
    if (out / MARKER).exists():
        summary: dict[str, Any] = files.read_json(out / MARKER)["summary"]
        return summary
    subject = make_subject()
    with stage(f"evaluation: {subject.name}", "steps") as progress:
        return evaluate_into(out, subject, seeds, workers, progress)


def evaluate_into(
    out: Path,
    subject: Subject,
    seeds: Sequence[int],
    workers: int | None = None,
    progress: Callable[..., None] | None = None,
) -> dict[str, Any]:
    """Evaluate, store everything in the folder `out` and return the summary.

    Args:
        out: folder for rows, films and summary.
        subject: who acts.
        seeds: start seeds.
        workers: processes.
        progress: called as progress(steps done, steps at most).
    """
    from surgicai_vision.scene import build_scene

    episodes = evaluate(
        subject.make_agent, subject.config, seeds, workers=workers, progress=progress
    )
    about = {
        "command": command_line(),
        "provenance": provenance(),
        "scene_hash": build_scene(subject.config.scene).hash,
        **subject.about,
        "task_config": to_mapping(subject.config),
    }
    return write_evaluation(out, episodes, about)
