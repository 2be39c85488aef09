"""The released detector finds the jaws where cameras, joints and looks are off."""

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_number
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.corruption import CORRUPTIONS, Moment, spoilt
from surgicai_vision.detection.card import RELEASED, detector_folder
from surgicai_vision.detection.detector import load_detector
from surgicai_vision.detection.examples import PART, WHOLE, distances, shrunk
from surgicai_vision.envs.projection import jaws_in_image
from surgicai_vision.evaluation.robustness.axes import ALL, AXES, shifted_config

STARTS = range(names.VALIDATION_SEED, names.VALIDATION_SEED + 6)
CLOSE = 0.02
"""Median error as a share of the image's height: about 2 mm at the holes."""
LOOKS = RandomisationConfig(appearance="train")


def found(config, camera, arm, strength):
    """Errors of the detector at the starts of a task, as shares of the image's height."""
    detector = load_detector(detector_folder(RELEASED))
    env = envs.make(config)
    errors = []
    for seed in STARTS:
        env.reset(seed=seed)
        image = env.image(camera, WHOLE).astype(np.uint8)
        strengths = dict.fromkeys(CORRUPTIONS, strength)
        image = spoilt(image, strengths, Moment(seed, 0, camera_number(camera), PART))
        places, _ = detector.find(shrunk(image)[None], camera)
        true = np.array(jaws_in_image(env.simulation, camera, arm, WHOLE))
        errors.append(distances(places[0, names.ARMS.index(arm)], true))
    return errors


@pytest.mark.parametrize("camera", ["front", "back"])
@pytest.mark.parametrize(("task", "arm"), [("place", "psm2"), ("handoff", "psm1")])
@pytest.mark.parametrize("strength", [0.0, 0.5])
def test_it_finds_the_jaws(camera, task, arm, strength):
    plain = TaskConfig(task, randomisation=LOOKS)
    errors = found(shifted_config(plain, AXES[ALL], strength), camera, arm, strength)
    assert np.median(errors) < CLOSE, errors


def test_it_knows_the_cameras_of_the_crops():
    detector = load_detector(detector_folder(RELEASED))
    assert detector.card.cameras == ("front", "back")
