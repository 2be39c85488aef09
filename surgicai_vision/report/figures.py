"""Figures: the page's static images.

What each view sees, a success and a failure, rollouts side by side.
"""

import base64
from collections.abc import Sequence

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.errors import SurgicaiError
from surgicai_vision.core.words import plural
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation.storage import read_film
from surgicai_vision.report.episodes import film_id
from surgicai_vision.report.filmstrips import Choice, Reel, camera_and_modality
from surgicai_vision.report.groups import Group, best_trained

SIZE = 224
"""Height and width of the large images [px]."""


def static_images(groups: Sequence[Group], reel: Reel) -> dict[str, object]:
    """Return views, a success, a failure and rollouts side by side, or why there are none.

    One film that cannot be shown does not take the others with it.
    """
    colours = ["#" + bytes(colour).hex() for colour in contact_sheet.PALETTE]
    parts = [
        {"name": name, "colour": colour} for name, colour in zip(names.PARTS, colours, strict=True)
    ]
    shown = {
        task: [_rollout(choice, reel) for choice in choices]
        for task, choices in reel.compared.items()
    }
    problem = reel.problem
    views: list[dict[str, object]] = []
    if not problem:
        try:
            views = _views(groups, reel)
        except SurgicaiError as error:
            problem = f"No images: {error}"
    outcomes = ((True, "success"), (False, "failure"))
    return {
        "image_size": SIZE,
        "parts": parts,
        "no_images": problem,
        "views": views,
        "strips": (
            [{"title": "", "frames": [], "text": reel.problem}]
            if reel.problem
            else [_strip(choose(groups, reel, success=won), word) for won, word in outcomes]
        ),
        "compared": [
            {"task": task, "start": reel.compared[task][0].row["seed"], "rollouts": rollouts}
            for task, found in shown.items()
            if len(rollouts := [rollout for rollout in found if rollout]) > 1
        ],
        "films": len(reel.strips),
        "films_wanted": reel.wanted - len(reel.left_out),
        "films_left_out": _left_out(reel),
    }


def choose(groups: Sequence[Group], reel: Reel, success: bool) -> Choice | None:
    """Choose the episode for a film.

    It is the best trained policy's first one, else another policy's; references come last, and
    after them evaluations with a film that cannot be shown.
    """
    best = best_trained(groups)
    damaged = {folder for folder, _ in reel.left_out}
    ordered = sorted(
        ((item, result) for item in groups for result in item.results),
        key=lambda pair: (
            str(pair[1].folder) in damaged,
            pair[0] is not best,
            not pair[0].condition.trained,
        ),
    )
    for item, result in ordered:
        for row in result.rows:
            if row["success"] == success and not row["error"]:
                return Choice(item, result, row)
    return None


def _left_out(reel: Reel) -> str:
    """Return how many films cannot be shown, with the first reason; empty if there are none."""
    count = len(reel.left_out)
    if not count:
        return ""
    reason = next(iter(reel.left_out.values()))
    what = plural(count, "film") + " cannot be shown"
    return f"{what}: {reason}" if count == 1 else f"{what}; the first: {reason}"


def _strip(choice: Choice | None, kind: str) -> dict[str, object]:
    """Render the large film strip of one episode."""
    if choice is None:
        return {
            "title": f"No {kind}",
            "frames": [],
            "text": f"No episode of any policy was a {kind}.",
        }
    row = choice.row
    condition = choice.group.condition
    view = choice.view
    title = f"A {kind} in {condition.task}"
    try:
        film = read_film(choice.result.folder, row["seed"])
        with contact_sheet.state_renderer(choice.result.config, SIZE) as image:
            frames = [
                {
                    "step": int(step),
                    "data": _data(contact_sheet.jpeg(image(state, *camera_and_modality(view)))),
                }
                for step, state in zip(film.steps, film.states, strict=True)
            ]
    except SurgicaiError as error:
        return {"title": title, "frames": [], "text": f"No images: {error}"}
    end = f"{row['d_trans_mm']:.1f} mm and {row['d_angle_deg']:.1f}° from the goal at the end"
    why = "" if row["success"] else f" ({row['failure']})"
    words = (
        f"{condition.policy}, start {row['seed']}, seen by {view}: {kind}{why} after {row['steps']}"
        f" steps; {end}."
    )
    return {"title": title, "frames": frames, "text": words}


def _rollout(choice: Choice, reel: Reel) -> dict[str, object] | None:
    """Return one of the rollouts from the same start, with its frames."""
    strip = reel.strips.get(choice.identity)
    if strip is None:
        return None
    frames = [
        {"step": step, "data": f"data:image/jpeg;base64,{frame}"}
        for step, frame in zip(strip.steps, strip.frames, strict=True)
    ]
    label = choice.group.label
    success = bool(choice.row["success"])
    return {
        "id": film_id(choice.identity),
        "label": label,
        "outcome": strip.outcome,
        "success": success,
        "view": strip.view,
        "frames": frames,
    }


def _views(groups: Sequence[Group], reel: Reel) -> list[dict[str, object]]:
    """Render every modality of the views that were used, at the start of an episode."""
    used = {names.camera_of(view) for item in groups for view in item.condition.views}
    shown = [view for view in camera_names() if view in (used or {"front", "back"})]
    chosen = choose(groups, reel, success=True) or choose(groups, reel, success=False)
    if chosen is None:
        return []
    film = read_film(chosen.result.folder, chosen.row["seed"])
    if not len(film.steps):
        return []
    start = chosen.row["seed"]
    views: list[dict[str, object]] = []
    with contact_sheet.state_renderer(chosen.result.config, SIZE) as image:
        for view in shown:
            frames = {
                modality: image(film.states[0], view, modality) for modality in names.MODALITIES
            }
            needle = np.all(
                frames[names.SEGMENTATION] == contact_sheet.PALETTE[names.PARTS.index("needle")],
                axis=-1,
            )
            share = 100 * float(needle.mean())
            views.append(
                {
                    "name": view,
                    "text": (
                        f"start {start}; the needle covers {share:.2f} % of the image. "
                        "Depth: near is red, far is blue."
                    ),
                    "images": [
                        {
                            "name": name.upper() if name == names.RGB else name,
                            "data": _image_data(frame, name),
                        }
                        for name, frame in frames.items()
                    ],
                }
            )
    return views


def _image_data(frame: contact_sheet.Image, modality: str) -> str:
    if modality == names.SEGMENTATION:
        return _data(contact_sheet.png(frame), "png")
    return _data(contact_sheet.jpeg(frame, 90))


def _data(content: bytes, kind: str = "jpeg") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
