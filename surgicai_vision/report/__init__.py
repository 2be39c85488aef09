"""Report: stored results → one self-contained page.

A results folder holds evaluations (`results.find_evaluations`) anywhere below it and, where a run wrote
it, `run.json`: its title, command, stages with their seconds, versions and machine. Pictures are rendered
anew from the states kept of each episode, so results stay small and the page can be rebuilt at any time.
"""

import base64
import datetime
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgicai_vision import files, names, pictures
from surgicai_vision.config import TaskConfig, from_mapping
from surgicai_vision.errors import BadFile, SurgicaiError
from surgicai_vision.results import MARKER, find_evaluations, read_film, read_rows

RUN_FILE = "run.json"
PICTURE_SIZE, STRIP_COLUMNS = 224, 5
FLOW = ("demos", "dataset", "features", "policy", "evaluation")
REFERENCES = ("expert", "random", "zero")
"""Policies that were not trained: what the trained ones stand beside."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Result:
    """One stored evaluation: its folder, its summary, how it was made, its rows."""

    folder: Path
    summary: dict[str, Any]
    about: dict[str, Any]
    rows: list[dict[str, Any]]

    @property
    def trained(self) -> bool:
        """Whether a checkpoint was evaluated."""
        return self.summary["policy"] not in REFERENCES

    @property
    def config(self) -> TaskConfig:
        """The task it was evaluated on."""
        return from_mapping(TaskConfig, self.about["task_config"])


def write_report(folder: Path, out: Path | None = None, progress: Progress | None = None) -> Path:
    """Write the page of the results below `folder` and return its path.

    Args:
        folder: results of quickstart, evaluate or sweep.
        out: the page, by default `folder`/report.html.
        progress: called as progress(parts done, parts).

    Raises:
        BadFile: a folder without a whole evaluation.
    """
    report = progress or (lambda done, total: None)
    results = read_results(folder)
    report(1, 4)
    run = files.read_json(folder / RUN_FILE) if (folder / RUN_FILE).exists() else {}
    page = {**_numbers(results), **_origin(results, run), "title": run.get("title", folder.name)}
    report(2, 4)
    page.update(_pictures(results))
    report(3, 4)
    path = out or folder / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, render_page(page).encode())
    report(4, 4)
    return path


def read_results(folder: Path) -> list[Result]:
    """Read all evaluations below `folder`; trained policies first."""
    results = []
    for place in find_evaluations(folder):
        stored = files.read_json(place / MARKER)
        results.append(Result(place, stored["summary"], stored["about"], read_rows(place)))
    if not results:
        raise BadFile(f"{folder} holds no evaluation; run `surgicai-vision evaluate POLICY --out {folder}` first.")
    return sorted(results, key=_order)


def _order(result: Result) -> tuple[Any, ...]:
    """Trained policies first, by encoder, views and training seed; then the references."""
    views = [names.CAMERAS.index(view) for view in result.about.get("views") or ()]
    seed = result.about.get("checkpoint", {}).get("seed", 0)
    return (not result.trained, result.about.get("encoder") or result.summary["policy"], len(views), views, seed)


def render_page(page: dict[str, Any]) -> str:
    """Fill the template."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("surgicai_vision", "templates")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.get_template("report.html.j2").render(page)


def best_trained(results: Sequence[Result]) -> Result | None:
    """The trained policy with the highest success rate (the first of them), or None."""
    trained = [result for result in results if result.trained]
    return max(trained, key=lambda result: result.summary["success_rate"], default=None)


def _numbers(results: list[Result]) -> dict[str, Any]:
    """The headline and one table a task."""
    tasks = [task for task in names.TASKS if any(result.summary["task"] == task for result in results)]
    tables = []
    for task in tasks:
        of_task = [result for result in results if result.summary["task"] == task]
        best = best_trained(of_task)
        tables.append(
            {
                "task": task,
                "rows": [_row(result, best) for result in of_task],
                "caption": _caption(of_task),
            }
        )
    first = [result for result in results if result.summary["task"] == tasks[0]]
    return {"tables": tables, "headline": _headline(first), "lead": _lead(first)}


def _headline(results: list[Result]) -> str:
    """The main finding in one sentence."""
    shown = best_trained(results) or results[0]
    summary = shown.summary
    who = _policy_text(shown) + (f" on {_views_text(shown)}" if shown.about.get("views") else "")
    if shown.trained and not summary["successes"]:
        return f"No trained policy solves any of {summary['episodes']} held-out starts of {summary['task']}"
    return f"{who} solves {summary['successes']} of {summary['episodes']} held-out starts of {summary['task']}"


def _lead(results: list[Result]) -> str:
    """What the headline stands beside."""
    shown = best_trained(results) or results[0]
    first = f"{_percent(shown.summary['success_rate'])}, 95 % interval {_interval(shown.summary)}."
    parts = [f"That is {first}" if shown.summary["successes"] or not shown.trained else f"The best: {first}"]
    for result in results:
        if result is not shown:
            views = f" on {_views_text(result)}" if result.about.get("views") else ""
            count = f"{result.summary['successes']}/{result.summary['episodes']}"
            parts.append(f"{_policy_text(result)}{views} {count}")
    return parts[0] + (f" Beside it: {'; '.join(parts[1:])}." if parts[1:] else "")


def _row(result: Result, best: Result | None) -> dict[str, Any]:
    """One line of a table."""
    summary = result.summary
    low, high = summary["ci95"]
    failures = [f"{count} {kind}" for kind, count in summary["failures"].items()]
    kind = "" if result.trained else "reference"
    return {
        "kind": "best" if result is best and summary["successes"] else kind,
        "policy": _policy_text(result),
        "views": _views_text(result) or "–",
        "successes": summary["successes"],
        "episodes": summary["episodes"],
        "rate": _percent(summary["success_rate"]),
        "interval": _interval(summary),
        "low_x": f"{8 + 160 * low:.1f}",
        "high_x": f"{8 + 160 * high:.1f}",
        "rate_x": f"{8 + 160 * summary['success_rate']:.1f}",
        "length": _mean_text(summary["trajectory_length_mm"]),
        "steps": _mean_text(summary["time_steps"]),
        "failures": ", ".join(failures) or "none",
    }


def _caption(results: list[Result]) -> str:
    config, summary = results[0].config, results[0].summary
    seeds = f"{summary['first_seed']}–{summary['first_seed'] + summary['episodes'] - 1}"
    return (
        f"Successes of n episodes with the exact (Clopper–Pearson) interval; the same starts, seeds {seeds}, for "
        f"every policy. Trajectory length and time steps: mean ± standard deviation over successful episodes, of at "
        f"most {config.max_steps} steps. Failures: missed = never touched the needle; dropped = lost it; time = held "
        f"it when the time was over; error = diverged physics. Grasp by {config.scene.grasp}, "
        f"{config.tolerance} tolerances."
    )


def _origin(results: list[Result], run: dict[str, Any]) -> dict[str, Any]:
    """How the numbers were made."""
    made = run.get("provenance") or results[0].about.get("provenance", {})
    packages = [f"{name} {number}" for name, number in made.get("packages", {}).items() if number]
    hashes = sorted({str(result.about["scene_hash"]) for result in results if result.about.get("scene_hash")})
    facts = [
        ("data", run.get("data")),
        ("time", _stages_text(run.get("seconds", {}))),
        ("versions", ", ".join(packages)),
        ("Python", made.get("python")),
        ("machine", _machine_text(made)),
        ("GL renderer", made.get("renderer")),
        ("scene, sha256", ", ".join(hashes)),
    ]
    return {
        "command": run.get("command") or results[0].about.get("command"),
        "facts": [(name, value) for name, value in facts if value],
        "weights": [_weights_row(result) for result in results if result.about.get("checkpoint")],
        "not_run": run.get("not_run", []),
        "footer": f"Written on {datetime.date.today().isoformat()} from {len(results)} stored evaluations.",
    }


def _weights_row(result: Result) -> dict[str, Any]:
    checkpoint = result.about["checkpoint"]
    return {
        "policy": _policy_text(result) + (f" · {_views_text(result)}" if result.about.get("views") else ""),
        "encoder": result.about["encoder"],
        "sha256": (checkpoint.get("weights_sha256") or "–")[:16],
        "seed": checkpoint.get("seed", "–"),
        "dataset": (checkpoint.get("dataset") or "–")[:16],
    }


def _pictures(results: list[Result]) -> dict[str, Any]:
    """Views and film strips, or the reason why there are none."""
    colours = ["#" + bytes(colour).hex() for colour in pictures.PALETTE]
    parts = [{"name": name, "colour": colour} for name, colour in zip(names.PARTS, colours, strict=True)]
    page: dict[str, Any] = {
        "picture_size": PICTURE_SIZE,
        "strip_columns": STRIP_COLUMNS,
        "parts": parts,
        "no_pictures": "",
    }
    success, failure = _choose(results, success=True), _choose(results, success=False)
    try:
        page["strips"] = [_strip(success, "success"), _strip(failure, "failure")]
        page["views"] = _views(results)
    except SurgicaiError as error:
        reason = f"No pictures: {error}"
        page.update(views=[], strips=[{"title": "", "frames": [], "text": reason}], no_pictures=reason)
    return page


def _choose(results: list[Result], success: bool) -> tuple[Result, dict[str, Any]] | None:
    """The episode for a film: the best trained policy's first, else another's, references last."""
    best = best_trained(results)
    ordered = sorted(results, key=lambda result: (result is not best, not result.trained))
    for result in ordered:
        for row in result.rows:
            if row["success"] == success and not row["error"]:
                return result, row
    return None


def _strip(choice: tuple[Result, dict[str, Any]] | None, kind: str) -> dict[str, Any]:
    """Render the film strip of one episode."""
    if choice is None:
        return {"title": f"No {kind}", "frames": [], "text": f"No episode of any policy was a {kind}."}
    result, row = choice
    view = (result.about.get("views") or ["front"])[0]
    film = read_film(result.folder, row["seed"])
    with pictures.stage(result.config, PICTURE_SIZE) as picture:
        frames = [
            {"step": int(step), "data": _data(pictures.jpeg(picture(state, view)))}
            for step, state in zip(film.steps, film.states, strict=True)
        ]
    end = f"{row['d_trans_mm']:.1f} mm and {row['d_angle_deg']:.1f}° from the goal at the end"
    why = "" if row["success"] else f" ({row['failure']})"
    text = (
        f"{_policy_text(result)}, start {row['seed']}, seen by {view}: {kind}{why} after {row['steps']} steps; {end}."
    )
    return {"title": f"A {kind}", "frames": frames, "text": text}


def _views(results: list[Result]) -> list[dict[str, Any]]:
    """Render every modality of the views that were used, at the start of an episode."""
    used = {view for result in results for view in result.about.get("views") or ()}
    shown = [view for view in names.CAMERAS if view in (used or {"front", "back"})]
    chosen = _choose(results, success=True) or (results[0], results[0].rows[0])
    film = read_film(chosen[0].folder, chosen[1]["seed"])
    views = []
    with pictures.stage(chosen[0].config, PICTURE_SIZE) as picture:
        for view in shown:
            frames = {modality: picture(film.states[0], view, modality) for modality in names.MODALITIES}
            needle = np.all(frames[names.SEGMENTATION] == pictures.PALETTE[names.PARTS.index("needle")], axis=-1)
            share = 100 * float(needle.mean())
            views.append(
                {
                    "name": view,
                    "text": f"start {chosen[1]['seed']}; the needle covers {share:.2f} % of the picture. "
                    "Depth: near is red, far is blue.",
                    "pictures": [
                        {"name": name.upper() if name == names.RGB else name, "data": _picture_data(frame, name)}
                        for name, frame in frames.items()
                    ],
                }
            )
    return views


def _picture_data(frame: pictures.Picture, modality: str) -> str:
    if modality == names.SEGMENTATION:
        return _data(pictures.png(frame), "png")
    return _data(pictures.jpeg(frame, 90))


def _data(content: bytes, kind: str = "jpeg") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _policy_text(result: Result) -> str:
    encoder = result.about.get("encoder")
    seed = result.about.get("checkpoint", {}).get("seed")
    return f"{encoder or result.summary['policy']}" + (f" (seed {seed})" if seed else "")


def _views_text(result: Result) -> str:
    return " + ".join(result.about.get("views") or ())


def _percent(rate: float) -> str:
    return f"{100 * rate:.0f} %"


def _interval(summary: dict[str, Any]) -> str:
    low, high = summary["ci95"]
    return f"{100 * low:.0f}–{100 * high:.0f} %"


def _mean_text(value: dict[str, float | None]) -> str:
    if value["mean"] is None:
        return "–"
    return f"{value['mean']:.1f}" + (f" ± {value['std']:.1f}" if value["std"] is not None else "")


def _stages_text(seconds: dict[str, float]) -> str:
    """Where the time went; `seconds` maps a stage's name to its time [s]."""
    ordered = sorted(seconds.items(), key=lambda item: FLOW.index(item[0]) if item[0] in FLOW else len(FLOW))
    parts = [f"{name} {value:.0f} s" for name, value in ordered]
    return f"{sum(seconds.values()):.0f} s: {', '.join(parts)}" if parts else ""


def _machine_text(made: dict[str, Any]) -> str:
    if not made:
        return ""
    return f"{made['processor']}, {made['cores']} cores, {made['system']}"
