"""Choose the span of the endoscope's crops by how well the needle's tip can be read from them.

    python benchmarks/crop_span.py --episodes 60 --out outputs/crop-span

The expert's episodes are rendered from the left eye and from both, whole and as crops of several
spans about the active arm. From the frozen features of `--encoder` and the arm's reported pose, a
linear probe (`features.probe`) predicts the tip's position in world; it is tested on episodes that
it was not fitted on. Prints a table and, last, one JSON object. An interrupted run continues with
the same command.

Crops and whole images have the same number of pixels, so a smaller span is a higher resolution: at
224 pixels, 50, 30 and 20 mm are 0.22, 0.13 and 0.09 mm per pixel. The endoscope's sensor has 0.09.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

from common import emit

from surgicai_vision.core import names
from surgicai_vision.core.cameras import CAMERAS, register_camera
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import open_dataset, render_demos
from surgicai_vision.dataset.reader import RenderedDataset
from surgicai_vision.demos.record import record
from surgicai_vision.features.cache import encode
from surgicai_vision.features.encoders import load_encoder
from surgicai_vision.features.probe import Probe, probe
from surgicai_vision.scene.cameras import Crop, crop_of

SPANS = (50, 30, 20)
"""Heights of the area that a crop shows [mm]."""
EYES = names.ENDOSCOPE_CAMERAS


def crop_name(eye: str, arm: str, span: int) -> str:
    """Return the name of a crop of one eye about an arm."""
    return f"{eye}_{arm}_{span}mm"


def register_crops() -> None:
    """Register the crops of every eye, arm and span, also in workers, which import this module."""
    for eye in EYES:
        for arm in names.ARMS:
            ours = crop_of(f"{eye}_{arm}")
            assert ours is not None
            for span in SPANS:
                name = crop_name(eye, arm, span)
                if name not in CAMERAS.names():
                    register_camera(name, Crop(eye, arm, ours.distance, span * 1e-3, ours.aspect))


register_crops()


class Row(NamedTuple):
    """One row of the table: what was seen, by how many eyes, and the probe's result."""

    seen: str
    eyes: int
    found: Probe

    def text(self, task: str) -> str:
        """Return the row in Markdown."""
        tip = self.found.tip
        return (
            f"| {task} | {self.seen} | {self.eyes or '–'} | {tip.median:.2f} "
            f"({tip.low:.2f}–{tip.high:.2f}) | {self.found.angle.median:.1f} |"
        )


def measure(task: str, chosen: argparse.Namespace) -> list[Row]:
    """Record, render, encode and probe one task."""
    context = RunContext(chosen.workers)
    demos = chosen.out / f"{task}-demos"
    data = chosen.out / f"{task}-data"
    record(TaskConfig(task), episodes=chosen.episodes, out=demos, context=context)
    arm = names.ACTIVE_ARM[task]
    seen = {"whole": EYES} | {
        f"{span} mm": tuple(crop_name(eye, arm, span) for eye in EYES) for span in SPANS
    }
    views = [view for pair in seen.values() for view in pair]
    render_demos(demos, data, views=views, frame_stride=chosen.frame_stride, context=context)
    dataset = open_dataset(data)
    encoder = load_encoder(chosen.encoder, chosen.pool)
    entries = {view: encode(dataset, view, encoder, chosen.out / "cache") for view in views}
    rows = [Row("proprioception alone", 0, probe(dataset, [], proprioception=True))]
    for name, pair in seen.items():
        for count in (1, 2):
            features = [entries[view] for view in pair[:count]]
            rows.append(Row(name, count, probe(dataset, features, proprioception=True)))
    _say(task, dataset, rows)
    return rows


def _say(task: str, dataset: RenderedDataset, rows: list[Row]) -> None:
    """Print the rows of one task."""
    print(f"{task}: {len(dataset.bounds())} episodes, {dataset.length} frames")
    for row in rows:
        print(row.text(task), flush=True)


def main() -> None:
    """Measure every task and print the table and one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=names.SUBTASKS, nargs="+", default=("grasp", "place"))
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--frame-stride", type=int, default=10)
    parser.add_argument("--encoder", default="imagenet-lite")
    parser.add_argument("--pool", default="global")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("outputs/crop-span"))
    chosen = parser.parse_args()
    found: dict[str, list[dict[str, Any]]] = {}
    for task in chosen.task:
        found[task] = [
            {"seen": row.seen, "eyes": row.eyes, **row.found.row()} for row in measure(task, chosen)
        ]
    settings = {key: getattr(chosen, key) for key in ("episodes", "encoder", "pool")}
    emit("crop_span", {**settings, "tasks": found}, render=True)


if __name__ == "__main__":
    main()
