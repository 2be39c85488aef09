"""First stitch: one whole procedure that a person can watch, as a video and a film strip.

    sewing = find_sewer("released:suture")
    row = sew(sewing, Path("outputs/quickstart/procedure"), say=print)

The folder gets `procedure.mp4`, `procedure.webp` (the same as an animation, for a page that
plays no video), `strip.jpg`, `poster.jpg` (the video's first image) and, written last,
`procedure.json`. If this file exists, nothing is done again.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import files, names
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.progress import Stage, silent_stage
from surgicai_vision.core.video import Image, read_video, write_animation, write_video
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation.films import Look, outcome_of
from surgicai_vision.evaluation.metrics import EpisodeMetrics
from surgicai_vision.evaluation.overlay import video_frames
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.slot import Slot
from surgicai_vision.evaluation.storage import Row
from surgicai_vision.experiments.quickstart_config import Quickstart

MARKER: Final = "procedure.json"
VIDEO: Final = "procedure.mp4"
POSTER: Final = "poster.jpg"
STRIP: Final = "strip.jpg"
MOVING: Final = "procedure.webp"
MOVING_EVERY: Final = 2
MOVING_QUALITY: Final = 60
MOVING_EFFORT: Final = 2
"""The animation takes every `MOVING_EVERY`-th image of the video, as WebP of this quality: 0.9 MB
for a procedure of 8 s."""
STARTS: Final = range(names.TEST_SEED, names.TEST_SEED + 3)
"""Held-out starts that are tried in order; each failure is reported."""
LOOK: Final = Look(views=("front", "back"), size=320)
STRIP_SIZE: Final = 224
"""Height and width of the film strip's images [px]."""


@dataclass(frozen=True)
class Sewer:
    """Who sews.

    Attributes:
        spec: what acts.
        name: its name.
        who: who that is, in words.
        why: why it is not the requested one; "" where it is.
    """

    spec: PolicySpec
    name: str
    who: str
    why: str = ""


def find_sewer(given: str) -> Sewer:
    """Return who sews: the requested policy or, if the default cannot be used, the expert.

    Args:
        given: whatever `open_policy` takes for a whole procedure. The default, a released policy,
            is replaced by the scripted expert where it is not there or of another scene.

    Raises:
        InputError: it does not exist, or cannot sew a whole procedure.
    """
    expert = "the scripted expert, which reads the simulator's state and sees no image"
    if given == "expert":
        return Sewer(open_policy(given, task=names.SUTURE), given, expert)
    try:
        spec = open_policy(given, task=names.SUTURE)
    except InputError as error:
        if given != Quickstart.procedure:
            raise
        why = str(error).removeprefix(given).removeprefix(":").strip()
        return Sewer(open_policy("expert", task=names.SUTURE), "expert", expert, why)
    return Sewer(spec, given, f"{given}, a policy that sees images" if spec.run.views else given)


def sew(
    sewer: Sewer,
    out: Path,
    say: Callable[[str], None],
    stage: Stage = silent_stage,
    starts: Sequence[int] = STARTS,
) -> Row:
    """Sew from the first start that succeeds, and film it.

    Args:
        sewer: who sews.
        out: folder to make or to continue.
        say: called with a line as each subtask ends.
        stage: shows progress.
        starts: seeds of the starts; the last one is filmed even if it fails.

    Returns:
        What `procedure.json` holds: who sewed, "success", "subtasks" with the simulated time [s] at
        which each ended, the number of starts that "failed", and the "seconds" it took.
    """
    if (out / MARKER).exists():
        known: Row = files.read_json(out / MARKER)
        say(f"  {known['text']}: {out / VIDEO}")
        return known
    out.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    slot = Slot(0, sewer.spec.make_agent(), sewer.spec.config)
    try:
        attempts = _attempts(slot, starts, say, stage)
        shown = attempts[-1]
        row = shown.row
        title = f"{sewer.name}, start {row.seed}"
        frames = video_frames(
            sewer.spec.config, slot.states, slot.moments, title, outcome_of(row), LOOK
        )
        total = len(slot.states) // LOOK.every
        with stage("filming", "images") as progress:
            frames = _counted(_with_poster(frames, out / POSTER), progress, total)
            fps = LOOK.fps(sewer.spec.config.action_repeat)
            write_video(out / VIDEO, frames, fps)
        moving = read_video(out / VIDEO)[::MOVING_EVERY]
        write_animation(out / MOVING, moving, fps / MOVING_EVERY, MOVING_QUALITY, MOVING_EFFORT)
        _strip(sewer, slot.states, shown.ends, out / STRIP)
    finally:
        slot.env.close()
    failed = len(attempts) - row.success
    tried = f", after {failed} that failed" if failed and row.success else ""
    told = {
        "who": sewer.who,
        "why": sewer.why,
        "policy": row.policy,
        "start": row.seed,
        "success": row.success,
        "failed": failed,
        "subtasks": [
            {"subtask": subtask, "end_s": step / names.FPS} for subtask, step in shown.ends.items()
        ],
        "seconds": time.monotonic() - begun,
        "text": f"{'sewn' if row.success else 'not sewn'} from start {row.seed}{tried}, in "
        f"{row.steps / names.FPS:.1f} s of simulated time",
    }
    files.write_json(out / MARKER, told)
    say(f"  {told['text']}: {out / VIDEO}")
    return told


@dataclass(frozen=True)
class _Attempt:
    """One episode: its row, and the control step at which each subtask ended."""

    row: EpisodeMetrics
    ends: dict[str, int]


def _attempts(
    slot: Slot, starts: Sequence[int], say: Callable[[str], None], stage: Stage
) -> list[_Attempt]:
    """Run episodes until one succeeds; the slot keeps the last one's states."""
    attempts: list[_Attempt] = []
    for seed in starts:
        with stage(f"sewing: start {seed}", "steps") as progress:
            ends = _run(slot, seed, say, progress)
        attempts.append(_Attempt(slot.take().row, ends))
        if attempts[-1].row.success:
            break
        say(f"  start {seed}: {outcome_of(attempts[-1].row)}")
    return attempts


def _run(
    slot: Slot, seed: int, say: Callable[[str], None], progress: Callable[..., None]
) -> dict[str, int]:
    """Run an episode; return the control step at which each subtask ended."""
    ends: dict[str, int] = {}
    slot.begin(seed)
    while not slot.ended:
        slot.step(slot.agent.act([0], [slot.env], [slot.observation])[0])
        progress(slot.steps, slot.task_config.max_steps)
        done = names.SUBTASKS[: slot.moments[-1].stages]
        for subtask in done:
            if subtask not in ends:
                ends[subtask] = len(slot.states) - 1
                say(f"  {subtask:<8} done after {slot.steps / names.FPS:4.1f} s")
    return ends


def _with_poster(frames: Iterator[Image], path: Path) -> Iterator[Image]:
    """Yield the frames and write the first of them as a JPEG."""
    for index, frame in enumerate(frames):
        if index == 0:
            files.write_bytes(path, contact_sheet.jpeg(frame))
        yield frame


def _counted(frames: Iterator[Image], progress: Callable[..., None], total: int) -> Iterator[Image]:
    """Yield the frames and report how many there have been."""
    for count, frame in enumerate(frames, 1):
        progress(min(count, total), total)
        yield frame


def _strip(
    sewer: Sewer, states: Sequence[NDArray[np.float64]], ends: dict[str, int], path: Path
) -> None:
    """Write the film strip: the start and the end of each subtask, in every view of the video."""
    columns = ["start", *(f"{name}, {step / names.FPS:.1f} s" for name, step in ends.items())]
    shown = [states[step] for step in (0, *ends.values())]
    with contact_sheet.state_renderer(sewer.spec.config, STRIP_SIZE) as draw:
        rows = [(view, [draw(state, view) for state in shown]) for view in LOOK.views]
    figure = contact_sheet.sheet(rows, columns, f"The whole procedure by {sewer.who}")
    contact_sheet.write(figure, path, dpi=100)
