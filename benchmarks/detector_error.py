"""How far from the jaws a detector is, in worlds where more and more is off.

    python benchmarks/detector_error.py --task place --arm psm2 --starts 100
    python benchmarks/detector_error.py --sheet docs/detection.jpg

Each row is a world: validation starts (500000–) of the widened world of `sweep unmoved`, with the
cameras, joints, looks or images of an axis of `robustness` off on top. The error is the distance in
the image between the place found and the true one, in mm at the depth of the holes; starts whose
jaws are outside the image are counted apart.
"""

import argparse
import dataclasses

import cv2
import numpy as np

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.corruption import Image, Moment, spoilt
from surgicai_vision.core.files import configs_folder
from surgicai_vision.detection.card import RELEASED, detector_folder
from surgicai_vision.detection.detector import load_detector
from surgicai_vision.detection.examples import PART, WHOLE, are_shown, distances, shrunk
from surgicai_vision.envs.projection import jaws_in_image
from surgicai_vision.evaluation.aimed_agent import cut
from surgicai_vision.evaluation.robustness import AXES
from surgicai_vision.evaluation.robustness.axes import shifted_config
from surgicai_vision.experiments.plan_config import read_plan
from surgicai_vision.scene.cameras import crop_of

SIDE = 224
"""Height and width of a crop [pixel]."""
HEIGHT = {"front": 96.0, "back": 105.0}
"""Height of what a camera shows at the holes [mm]."""
WORLDS = (("", 0.0), ("heldout", 0.0), ("camera", 0.5), ("camera", 1.0), ("all", 0.5))
"""Axis of `robustness` ("heldout": looks of held-out families) and its strength."""
SHOWN = (("camera", 500_001), ("all", 500_004), ("all", 500_011))
"""Axis at half strength and start of each row of the sheet."""


def world(task: str, axis: str, strength: float) -> TaskConfig:
    """Return the widened world of a task with an axis off."""
    plain = read_plan(configs_folder() / "sweep" / "unmoved.yaml").task_config(task)
    if axis == "heldout":
        looks = dataclasses.replace(plain.randomisation, appearance=names.HELDOUT)
        return dataclasses.replace(plain, randomisation=looks)
    return shifted_config(plain, AXES[axis], strength) if axis else plain


def corrupted(image: Image, axis: str, strength: float, moment: Moment) -> Image:
    """Return an image as the axis spoils it."""
    kinds = AXES[axis].images if axis in AXES else ()
    return spoilt(image, dict.fromkeys(kinds, strength), moment)


def errors(options: argparse.Namespace, axis: str, strength: float) -> dict[str, list[float]]:
    """Return camera → distance of each start's jaws from where they are found [mm]."""
    detector = load_detector(detector_folder(options.detector))
    env = envs.make(world(options.task, axis, strength))
    arm = names.ARMS.index(options.arm)
    found: dict[str, list[float]] = {camera: [] for camera in HEIGHT}
    for seed in range(names.VALIDATION_SEED, names.VALIDATION_SEED + options.starts):
        env.reset(seed=seed)
        for camera, height in HEIGHT.items():
            moment = Moment(seed, 0, camera_number(camera), PART)
            whole = env.image(camera, WHOLE).astype(np.uint8)
            image = corrupted(whole, axis, strength, moment)
            places, _ = detector.find(shrunk(image)[None], camera)
            true = np.array(jaws_in_image(env.simulation, camera, options.arm, WHOLE))
            if are_shown(true):
                found[camera].append(float(distances(places[0, arm], true)) * height)
    env.close()
    return found


def write_sheet(options: argparse.Namespace) -> None:
    """Write an image of the crops where the arm reports its jaws and where they are seen."""
    detector = load_detector(detector_folder(options.detector))
    height, width = WHOLE
    rows = []
    for axis, seed in SHOWN:
        env = envs.make(world(options.task, axis, 0.5))
        env.reset(seed=seed)
        row = []
        for camera in HEIGHT:
            view = f"{camera}_{options.arm}"
            number = camera_number(camera)
            image = env.image(camera, WHOLE).astype(np.uint8)
            image = corrupted(image, axis, 0.5, Moment(seed, 0, number, PART))
            reported = env.image(view, (SIDE, SIDE)).astype(np.uint8)
            places, _ = detector.find(shrunk(image)[None], camera)
            place = places[0, names.ARMS.index(options.arm)]
            crop, window = crop_of(view), env.calibration.window(view, (SIDE, SIDE))
            assert crop is not None and window is not None
            marked = image.copy()
            x, y = round(float(place[0]) * width), round(float(place[1]) * height)
            cv2.drawMarker(marked, (x, y), (255, 255, 0), cv2.MARKER_CROSS, 40, 3)
            scale = height / window.height
            left, top, side = (round(scale * at) for at in (window.left, window.top, SIDE))
            cv2.rectangle(marked, (left, top), (left + side, top + side), (255, 60, 60), 3)
            row += [
                cv2.resize(marked, (SIDE * width // height, SIDE), interpolation=cv2.INTER_AREA),
                corrupted(reported, axis, 0.5, Moment(seed, 0, number)),
                cut(image, crop, place, (SIDE, SIDE)),
            ]
        framed = [np.pad(each, ((2, 2), (2, 2), (0, 0)), constant_values=255) for each in row]
        rows.append(np.concatenate(framed, axis=1))
        env.close()
    sheet = np.concatenate(rows)[..., ::-1]
    cv2.imwrite(options.sheet, sheet, [cv2.IMWRITE_JPEG_QUALITY, 75])


def main() -> None:
    """Print a row for each world and camera."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detector", default=RELEASED)
    parser.add_argument("--task", default="place")
    parser.add_argument("--arm", default="psm2", choices=names.ARMS)
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--sheet", help="write an image of crops to this file instead")
    options = parser.parse_args()
    if options.sheet:
        write_sheet(options)
        return
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
