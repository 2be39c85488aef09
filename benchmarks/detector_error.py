"""How far from the jaws a detector is, in worlds where more and more is off.

    python benchmarks/detector_error.py --task place --arm psm2 --starts 100

Each row is a world: validation starts (500000–) of the widened world of `sweep unmoved`, with the
cameras, joints, looks or images of an axis of `robustness` off on top. The error is the distance in
the image between the place found and the true one, in mm at the depth of the holes; starts whose
jaws are outside the image are counted apart.
"""

import argparse
import dataclasses

import numpy as np

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig
from surgicai_vision.core.corruption import CORRUPTIONS, Moment
from surgicai_vision.detection.card import RELEASED, detector_folder
from surgicai_vision.detection.detector import load_detector
from surgicai_vision.detection.example_jobs import shrunk
from surgicai_vision.detection.examples import PART, WHOLE
from surgicai_vision.envs.projection import jaws_in_image
from surgicai_vision.evaluation.robustness import AXES
from surgicai_vision.evaluation.robustness.axes import shifted_config

WIDENED = RandomisationConfig(
    phantom_shift=10,
    phantom_turn=15,
    pair="any",
    robot_start=15,
    needle_size=0.06,
    needle_arc="train",
    needle_thickness=0.15,
    appearance="train",
)
HEIGHT = {"front": 96.0, "back": 105.0}
"""Height of what a camera shows at the holes [mm]."""
WORLDS = (("", 0.0), ("heldout", 0.0), ("camera", 0.5), ("camera", 1.0), ("all", 0.5))
"""Axis of `robustness` ("heldout": looks of held-out families) and its strength."""


def errors(options: argparse.Namespace, axis: str, strength: float) -> dict[str, list[float]]:
    """Return camera → distance of each start's jaws from where they are found [mm]."""
    detector = load_detector(detector_folder(options.detector))
    plain = TaskConfig(options.task, scene=SceneConfig(ink="due"), randomisation=WIDENED)
    if axis == "heldout":
        looks = dataclasses.replace(WIDENED, appearance="heldout")
        config = dataclasses.replace(plain, randomisation=looks)
    else:
        config = shifted_config(plain, AXES[axis], strength) if axis else plain
    spoilt = AXES[axis].images if axis in AXES else ()
    env = envs.make(config)
    arm = names.ARMS.index(options.arm)
    found: dict[str, list[float]] = {camera: [] for camera in HEIGHT}
    for seed in range(names.VALIDATION_SEED, names.VALIDATION_SEED + options.starts):
        env.reset(seed=seed)
        for camera, height in HEIGHT.items():
            image = env.image(camera, WHOLE).astype(np.uint8)
            moment = Moment(seed, 0, camera_number(camera), PART)
            for kind in spoilt:
                image = CORRUPTIONS[kind](image, strength, moment)
            places, _ = detector.find(shrunk(image)[None], camera)
            true = np.array(jaws_in_image(env.simulation, camera, options.arm, WHOLE))
            if ((true >= 0) & (true <= 1)).all():
                off = (places[0, arm] - true) * (WHOLE[1] / WHOLE[0], 1.0) * height
                found[camera].append(float(np.linalg.norm(off)))
    env.close()
    return found


def main() -> None:
    """Print a row for each world and camera."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detector", default=RELEASED)
    parser.add_argument("--task", default="place")
    parser.add_argument("--arm", default="psm2", choices=names.ARMS)
    parser.add_argument("--starts", type=int, default=100)
    options = parser.parse_args()
    for axis, strength in WORLDS:
        for camera, off in errors(options, axis, strength).items():
            middle, most = np.percentile(off, (50, 90))
            outside = options.starts - len(off)
            print(
                f"{axis or 'widened world'} {strength or ''} {camera}: median {middle:.2f} mm, "
                f"90 % within {most:.2f} mm, at most {max(off):.1f} mm; {outside} not in the image",
                flush=True,
            )


if __name__ == "__main__":
    main()
