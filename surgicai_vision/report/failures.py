"""Failures: one image of how the best policies fail, in film strips, for a paper or a README."""

import base64
import io
from collections.abc import Iterator, Sequence

from surgicai_vision.core.tasks import task_names
from surgicai_vision.envs import contact_sheet
from surgicai_vision.report.filmstrips import Reel, Strip
from surgicai_vision.report.groups import Group, best_trained, of_task

MOST = 8
"""Most strips in the image."""
DOTS = 60
QUALITY = 80
"""Dots per inch, at 2.1 inches per frame, and JPEG quality: eight strips stay below 300 kB."""


def failure_sheet(groups: Sequence[Group], reel: Reel) -> bytes | None:
    """Return a JPEG with failures of the best policy of each task; None if there is no strip.

    Each kind of failure appears once per task, in the view of its strip; frames are evenly spaced
    over the episode.
    """
    strips = list(_failures(groups, reel))[:MOST]
    if not strips:
        return None
    widest = max(len(strip.frames) for strip in strips)
    rows = [(_title(strip), _frames(strip, widest)) for strip in strips]
    figure = contact_sheet.sheet(rows, [""] * widest, "how the best policies fail: start to end")
    content = io.BytesIO()
    figure.savefig(content, format="jpeg", dpi=DOTS, pil_kwargs={"quality": QUALITY})
    return content.getvalue()


def _failures(groups: Sequence[Group], reel: Reel) -> Iterator[Strip]:
    """Yield the rendered strips of failures, task by task."""
    for task in task_names():
        best = best_trained(of_task(groups, task))
        seen = set()
        for strip in reel.strips.values():
            row = strip.choice.row
            if strip.choice.group is best and not row["success"] and row["failure"] not in seen:
                seen.add(row["failure"])
                yield strip


def _title(strip: Strip) -> str:
    return f"{strip.choice.row['task']} {strip.choice.row['seed']}\n{strip.outcome}"


def _frames(strip: Strip, count: int) -> list[contact_sheet.Image]:
    """Return the strip's frames; repeat the last if it has fewer than `count`."""
    frames = [contact_sheet.decoded(base64.b64decode(frame)) for frame in strip.frames]
    return [*frames, *[frames[-1]] * (count - len(frames))]
