"""Show soft tissue: a film of an insertion with its force curve, and close-ups of the skin.

    python benchmarks/soft_film.py
    python benchmarks/soft_film.py --out /tmp --tissue-forces skin --seed 500007

The expert throws a stitch, seen by the endoscope's left eye, cut from a larger image about the
marks.

* `soft_tissue.mp4`: the insertion, one control step of 20 ms per frame at `FPS` frames per second,
  and the force on the tissue as measured by the force plate.
* `soft_tissue.jpg`: what the skin does: the tip presses, is in, lifts the skin from inside, is out;
  the needle is drawn through; the wounds remain. Last, jaws that dent the flat tissue, and tissue
  torn by a needle that was driven along the wound.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from common import emit
from numpy.typing import NDArray
from PIL import Image as Pillow

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.core.video import Image, write_video
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs.force_plate import ForcePlate
from surgicai_vision.envs.skin import Skin
from surgicai_vision.envs.tissue import INSIDE, OUTSIDE, THROUGH, TRAILING, Tissue
from surgicai_vision.scene.cameras import Window
from surgicai_vision.scene.holes import Point
from surgicai_vision.scene.rendering import FrameRenderer

NAME = "soft_tissue"
CAMERA = "endo_left"
FPS = 15
"""Frames per second: control steps at 0.3 of their speed."""
FILM = (480, 640)
"""Height and width of the endoscope's part of the film [px]; the curve next to it is half as
wide."""
CLOSE = (300, 400)
"""Height and width of a close-up [px]."""
WIDE_MM = 26.0
"""Width that the film shows at the stitch [mm]."""
CLOSE_MM = 13.0
"""Width that a close-up shows [mm]."""
SLIDE_STEPS = 60
"""Control steps for which the needle is driven along the wound to tear the tissue."""


class Eye:
    """The endoscope's view of one env, cut about a point.

    Args:
        env: an env with soft tissue.
        size: height and width of the images [px].
        width_mm: width that they show at the point [mm].
    """

    def __init__(self, env: envs.SuturingEnv, size: tuple[int, int], width_mm: float):
        self._env = env
        self._size = size
        self._width = width_mm / 1e3
        self._renderer = FrameRenderer(
            env.model, *size, "high", Skin(env.simulation, tissue_of(env))
        )

    def look(self, at: Point) -> Image:
        """Return the image about a point [m, world], shifted to stay within the camera's image."""
        model = self._env.model
        data = self._env.data
        camera = model.camera(CAMERA).id
        x, y, z = data.cam_xmat[camera].reshape(3, 3).T @ (np.array(at) - data.cam_xpos[camera])
        height, width = self._size
        tangent = math.tan(math.radians(float(model.cam_fovy[camera])) / 2)
        focal = width * -z / self._width
        whole = 2 * math.ceil(focal * tangent)
        wide = 2 * math.ceil(whole * width / height / 2)
        left = min(max(round(wide / 2 + focal * x / -z - width / 2), 0), wide - width)
        top = min(max(round(whole / 2 - focal * y / -z - height / 2), 0), whole - height)
        window = Window(left=left, top=top, height=whole, width=wide)
        return np.asarray(self._renderer.render(data, CAMERA, names.RGB, window), np.uint8)

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def tissue_of(env: envs.SuturingEnv) -> Tissue:
    """Return the env's soft tissue."""
    tissue = env.simulation.tissue
    assert tissue is not None
    return tissue


def middle(env: envs.SuturingEnv) -> Point:
    """Return the point between the marks [m, world]."""
    pair = env.stitch.pair
    x, y, z = ((a + b) / 2 for a, b in zip(pair.entry.centre, pair.exit.centre, strict=True))
    return (x, y, z)


def film(scene: SceneConfig, seed: int, path: Path) -> dict[str, float]:
    """Film an insertion; return its peak force [N] and its number of frames."""
    env = envs.make(TaskConfig("insert", scene))
    env.reset(seed=seed)
    plate = ForcePlate(env.model, tissue_of(env))
    eye = Eye(env, FILM, WIDE_MM)
    expert = Expert(env)
    images = [eye.look(middle(env))]
    forces = [plate.force(env.data)]
    for _ in range(env.config.max_steps):
        ended = env.step(expert.action())[2]
        images.append(eye.look(middle(env)))
        forces.append(plate.force(env.data))
        if ended:
            break
    eye.close()
    curves = draw_curves(np.array(forces), env.dt)
    beside = (np.concatenate(pair, axis=1) for pair in zip(images, curves, strict=True))
    count = write_video(path, beside, FPS)
    return {"frames": count, "peak_n": round(max(forces), 2)}


def draw_curves(forces: NDArray[np.float64], dt: float) -> list[Image]:
    """Return the force curve up to each step, one image per step."""
    height, width = FILM
    figure, axes = plt.subplots(figsize=(width / 200, height / 100), dpi=100, layout="constrained")
    times = dt * np.arange(len(forces))
    axes.set_xlim(0.0, times[-1])
    axes.set_ylim(0.0, 1.1 * forces.max())
    axes.set_xlabel("time [s]")
    axes.set_title("force on the tissue [N]", loc="left", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    (line,) = axes.plot([], [], color="#b0563a", linewidth=1.5)
    (dot,) = axes.plot([], [], "o", color="#b0563a")
    images = []
    for now in range(len(forces)):
        line.set_data(times[: now + 1], forces[: now + 1])
        dot.set_data(times[now : now + 1], forces[now : now + 1])
        figure.canvas.draw()
        buffer = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
        images.append(np.ascontiguousarray(buffer[:, :, :3]))
    plt.close(figure)
    return images


def close_ups(scene: SceneConfig, seed: int) -> list[tuple[str, Image]]:
    """Return close-ups with their titles."""
    return [*_stitch(scene, seed), _jaws(scene, seed), _torn(scene, seed)]


def _stitch(scene: SceneConfig, seed: int) -> list[tuple[str, Image]]:
    """Throw a stitch; return the last image of each stage."""
    env = envs.make(TaskConfig("suture", scene))
    env.reset(seed=seed)
    tissue = tissue_of(env)
    expert = Expert(env)
    eye = Eye(env, CLOSE, CLOSE_MM)
    moments = {OUTSIDE: "the tip presses", INSIDE: "the tip lifts the skin from inside"}
    moments |= {THROUGH: "the needle is drawn through", TRAILING: "the needle's end leaves"}
    found = []
    stage = OUTSIDE
    image = eye.look(middle(env))
    for _ in range(env.config.max_steps):
        ended = env.step(expert.action())[2]
        now = eye.look(middle(env))
        if tissue.stage != stage:
            found.append((moments[stage], image))
            if tissue.stage == THROUGH:
                found.append(("the tip is out", now))
            stage = tissue.stage
        image = now
        if ended:
            break
    eye.close()
    return [*found, ("the wounds remain", image)]


def _jaws(scene: SceneConfig, seed: int) -> tuple[str, Image]:
    """Grasp; return the image of the deepest dent."""
    env = envs.make(TaskConfig("grasp", scene))
    env.reset(seed=seed)
    skin = Skin(env.simulation, tissue_of(env))
    expert = Expert(env)
    eye = Eye(env, CLOSE, 2 * CLOSE_MM)
    deepest = -1.0
    image = eye.look(env.simulation.grasp(names.PSM2)[:3])
    for _ in range(env.config.max_steps):
        ended = env.step(expert.action())[2]
        dent = max((-pull.way[2] for pull in skin.state().pulls), default=0.0)
        if dent > deepest:
            deepest = dent
            image = eye.look(env.simulation.grasp(names.PSM2)[:3])
        if ended:
            break
    eye.close()
    return "jaws dent the tissue", image


def _torn(scene: SceneConfig, seed: int) -> tuple[str, Image]:
    """Insert, then drive the needle along the wound until the tissue has torn."""
    env = envs.make(TaskConfig("insert", scene))
    env.reset(seed=seed)
    tissue = tissue_of(env)
    expert = Expert(env)
    eye = Eye(env, CLOSE, CLOSE_MM)
    _until(env, expert.action, lambda: tissue.stage == THROUGH, env.config.max_steps)
    base = np.array(env.simulation.bases[env.subtask.arm][3:]).reshape(3, 3)
    slide = np.array([*(base.T @ (0.0, 1.0, 0.0)), 0.0, 0.0, 0.0, 0.0], np.float32)
    _until(env, lambda: slide, lambda: tissue.tears > 0, SLIDE_STEPS)
    image = eye.look(middle(env))
    eye.close()
    return "the tissue tore" if tissue.tears else "driven along the wound", image


def _until(
    env: envs.SuturingEnv,
    act: Callable[[], NDArray[np.float32]],
    is_done: Callable[[], bool],
    steps: int,
) -> None:
    for _ in range(steps):
        if is_done() or env.step(act())[2]:
            return


def write_sheet(images: list[tuple[str, Image]], path: Path) -> None:
    """Write titled images as one, four per row."""
    columns = 4
    rows = -(-len(images) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.2 * columns, 2.65 * rows), layout="constrained", squeeze=False
    )
    for place in axes.ravel():
        place.axis("off")
    for place, (title, image) in zip(axes.ravel(), images, strict=False):
        place.imshow(image)
        place.set_title(title, fontsize=10)
    figure.savefig(path.with_suffix(".png"), dpi=110)
    plt.close(figure)
    with Pillow.open(path.with_suffix(".png")) as image:
        image.convert("RGB").save(path, quality=88)
    path.with_suffix(".png").unlink()


def main() -> None:
    """Film, take the close-ups, and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=names.VALIDATION_SEED)
    parser.add_argument("--tissue-forces", default=SceneConfig().tissue_forces)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    chosen = parser.parse_args()
    scene = SceneConfig(tissue="soft", tissue_forces=chosen.tissue_forces)
    row = film(scene, chosen.seed, chosen.out / f"{NAME}.mp4")
    images = close_ups(scene, chosen.seed)
    write_sheet(images, chosen.out / f"{NAME}.jpg")
    emit("soft_film", {"seed": chosen.seed, **row, "close_ups": [title for title, _ in images]})


if __name__ == "__main__":
    main()
