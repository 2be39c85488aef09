"""Aimed crops: cut as the scene renders them, where a detector sees the jaws, whatever is off."""

from dataclasses import replace

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.detection.card import RELEASED, DetectorCard, detector_folder, read_card
from surgicai_vision.detection.detector import write_detector
from surgicai_vision.detection.examples import PART, WHOLE
from surgicai_vision.detection.network import JawNetwork
from surgicai_vision.envs import aimed_calibration
from surgicai_vision.envs.aimed_calibration import AimedCalibration
from surgicai_vision.envs.projection import jaws_in_image
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.aimed_agent import AimedAgent, aimed, cut, middle
from surgicai_vision.evaluation.policy_spec import PolicySpec
from surgicai_vision.evaluation.robustness import shifted
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.scene.cameras import crop_of
from surgicai_vision.training.released import VARIABLE
from surgicai_vision.training.run_config import OWN, RunConfig, of_training

SIDE = 96
VIEWS = ("front_psm2", "back_psm2", "front_psm1")


class Looking(Agent):
    """An agent that keeps what it sees and does nothing."""

    name = "looking"
    cameras = VIEWS
    image_size = SIDE

    def __init__(self):
        self.seen = []

    def reset(self, slot, robot, seed):
        self.seen.clear()

    def act(self, slots, robots, observations):
        self.seen += [{key: np.array(seen[key]) for key in seen} for seen in observations]
        return np.zeros((len(slots), 7), np.float32)


class TruthDetector:
    """Stands in for a perfect detector of one env."""

    def __init__(self, env):
        self.env = env
        self.asked = []

    def find(self, images, camera):
        self.asked.append(camera)
        simulation = self.env.simulation
        places = [jaws_in_image(simulation, camera, arm, WHOLE) for arm in names.ARMS]
        return np.array([places], np.float32), np.ones((1, 2), np.float32)


def spec_of(views=VIEWS, config=TaskConfig("place", max_steps=3)):
    run = RunConfig(config, OWN, views, policy="looking")
    return PolicySpec(run, Looking)


@pytest.fixture
def folder(tmp_path):
    """An untrained detector of both cameras."""
    card = DetectorCard(("front", "back"), "", 0, 0, 0, {"front": 0.0, "back": 0.0}, "")
    write_detector(tmp_path / "detector", card, JawNetwork(2))
    return tmp_path / "detector"


def differ(one, other):
    """Mean difference of two images in grey levels."""
    return float(np.abs(one.astype(float) - other).mean())


@pytest.mark.parametrize("view", VIEWS)
def test_a_crop_is_cut_as_it_is_rendered(view):
    env = envs.make(TaskConfig("place"))
    env.reset(seed=names.VALIDATION_SEED)
    crop = crop_of(view)
    place = np.array(jaws_in_image(env.simulation, crop.camera, crop.arm, WHOLE), np.float32)
    rendered = env.image(view, (SIDE, SIDE))
    whole = env.image(crop.camera, WHOLE)
    at_place, aside = (cut(whole, crop, place + off, (SIDE, SIDE)) for off in (0.0, 0.01))
    # Only the sampling differs; a hundredth of the image beside it, edges do.
    assert differ(at_place, rendered) < 0.6 * differ(aside, rendered)
    assert differ(at_place, rendered) < 4


def test_crops_follow_the_jaws_where_cameras_and_joints_are_off():
    """With all of it off, the aimed crop shows the jaws in its middle; the nominal one need not."""
    off = RandomisationConfig(camera_shift=5.0, camera_turn=5.0, kinematic_error=0.5)
    env = envs.make(
        TaskConfig("place", randomisation=off),
        obs_type="pixels_agent_pos",
        cameras=("front", "back"),
        image_size=WHOLE,
    )
    looking = Looking()
    detector = TruthDetector(env)
    agent = AimedAgent(looking, detector)
    for seed in range(names.VALIDATION_SEED, names.VALIDATION_SEED + 3):
        observation, _ = env.reset(seed=seed)
        agent.reset(0, env, seed)
        agent.act([0], [env], [observation])
        seen = looking.seen[-1]
        assert set(seen) == {*VIEWS, "agent_pos"}
        np.testing.assert_array_equal(seen["agent_pos"], observation["agent_pos"])
        for view in VIEWS:
            crop = crop_of(view)
            place = np.array(jaws_in_image(env.simulation, crop.camera, crop.arm, WHOLE))
            np.testing.assert_array_equal(
                seen[view],
                cut(observation[crop.camera], crop, place.astype(np.float32), (SIDE, SIDE)),
            )
    assert detector.asked == ["front", "back"] * 3  # one look per camera, whatever the arms


@pytest.mark.parametrize("view", VIEWS)
def test_demonstrations_are_rendered_as_an_aimed_agent_sees_them(view, monkeypatch):
    """Apart from the detector's error, whatever is off: the same part at the same scale."""
    off = RandomisationConfig(
        camera_shift=5.0, camera_turn=5.0, camera_fovy=5.0, kinematic_error=0.5
    )
    env = envs.make(TaskConfig("place", randomisation=off))
    env.reset(seed=names.VALIDATION_SEED)
    crop = crop_of(view)
    place = np.array(jaws_in_image(env.simulation, crop.camera, crop.arm, WHOLE), np.float32)
    whole = env.image(crop.camera, WHOLE)
    at_place, aside = (cut(whole, crop, place + off, (SIDE, SIDE)) for off in (0.0, 0.01))
    monkeypatch.setattr(aimed_calibration, "ERROR", 0.0)
    env.place_crops_by(AimedCalibration(env.simulation, 0))
    rendered = env.image(view, (SIDE, SIDE))
    assert differ(at_place, rendered) < 0.6 * differ(aside, rendered)
    assert differ(at_place, rendered) < 4


def test_an_aimed_crop_is_off_by_as_much_as_a_detector():
    env = envs.make(TaskConfig("place"))
    size = (SIDE, SIDE)
    errors = []
    for seed in range(40):
        env.reset(seed=seed)
        for view in VIEWS:
            found = AimedCalibration(env.simulation, 7)
            window = found.window(view, size)
            assert window == found.window(view, size), "the same state has the same error"
            true = env.calibration.window(view, size)  # nothing is off here
            pixel = crop_of(view).span / SIDE
            errors.append(pixel * np.subtract((window.left, window.top), (true.left, true.top)))
    spread = np.std(errors)
    assert 0.8 * aimed_calibration.ERROR < spread < 1.3 * aimed_calibration.ERROR
    assert abs(np.mean(errors)) < 0.2 * aimed_calibration.ERROR
    assert len(np.unique(errors, axis=0)) > 10
    assert AimedCalibration(env.simulation, 7).window("front", size) is None


def test_an_aimed_agent_asks_for_whole_images_and_says_so():
    agent = AimedAgent(Looking(), None)
    assert agent.cameras == ("front", "back")
    assert agent.part("front") == agent.part("back") == PART
    assert (agent.image_size, round(agent.image_size * agent.aspect)) == WHOLE


class WristAgent(Looking):
    """Sees a camera on the arm as well."""

    cameras = ("wrist_psm2", "front_psm2")


def test_a_view_that_is_no_crop_stays_as_it_is(folder):
    env = envs.make(TaskConfig("place"))
    env.reset(seed=names.VALIDATION_SEED)
    rendered = env.image("wrist_psm2", (SIDE, SIDE))
    whole = env.image("wrist_psm2", WHOLE)
    assert differ(middle(whole, (SIDE, SIDE)), rendered) < 3
    assert differ(middle(whole[:, 16:], (SIDE, SIDE)), rendered) > 6  # 1.6 of its pixels aside
    wide = env.image("wrist_psm2", (SIDE, SIDE * 4 // 3))
    assert differ(middle(whole, wide.shape[:2]), wide) < 3
    agent = AimedAgent(WristAgent(), TruthDetector(env))
    assert agent.cameras == ("wrist_psm2", "front")
    assert (agent.part("wrist_psm2"), agent.part("front")) == (1.0, PART)
    spec = aimed(replace(spec_of(WristAgent.cameras), make=WristAgent), folder)
    shown = shifted(spec, "all", 0.5)
    for episode in evaluate(shown.make_agent, shown.config, [names.TEST_SEED], workers=1):
        assert not episode.row.error


def test_an_aimed_policy_is_evaluated_and_named_apart(folder):
    plain = spec_of()
    spec = aimed(plain, folder)
    assert spec.run.detector and spec.name != plain.name
    assert of_training(spec.run) == of_training(plain.run)
    seeds = range(names.TEST_SEED, names.TEST_SEED + 2)
    for one in (spec, shifted(spec, "all", 0.5)):
        episodes = evaluate(one.make_agent, one.config, seeds, workers=1)
        assert [episode.row.steps for episode in episodes] == [3, 3]
        assert not any(episode.row.error for episode in episodes)


def test_what_cannot_be_aimed_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match="front, wrist_psm2"):
        aimed(spec_of(("front", "wrist_psm2")), folder)
    with pytest.raises(InputError, match="no depth"):
        aimed(spec_of(("front_psm2", "front_psm2_depth")), folder)
    blind = replace(spec_of(), run=RunConfig(TaskConfig("place"), policy="zero"))
    with pytest.raises(InputError, match="no images"):
        aimed(blind, folder)
    with pytest.raises(UnknownName, match="endo_left"):
        aimed(spec_of(("endo_left_psm2",)), folder)
    card = DetectorCard(("endo_left",), "", 0, 0, 0, {"endo_left": 0.0}, "")
    write_detector(tmp_path / "endoscope", card, JawNetwork(1))
    with pytest.raises(InputError, match="times as wide as high"):
        aimed(spec_of(("endo_left_psm2",)), tmp_path / "endoscope")
    with pytest.raises(BadFile, match="train-detector"):
        aimed(spec_of(), tmp_path)
    with pytest.raises(UnknownName, match="Did you mean 'released:detector'"):
        aimed(spec_of(), "released:detectr")


@pytest.mark.parametrize("command", ["evaluate", "robustness"])
def test_the_commands_refuse_a_folder_without_a_detector(command, tmp_path, capsys):
    words = ["zero", "--task", "place", "--detector", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([command, *words]) == 2
    said = capsys.readouterr().err.strip()
    assert "train-detector" in said and "\n" not in said
    assert not (tmp_path / "out").exists()


class WideAgent(Looking):
    """Sees crops that are wider than high."""

    aspect = 4 / 3


class DeepAgent(Looking):
    """Needs the crops' depth."""

    depth = True


def test_a_crop_has_the_form_that_the_agent_asks_for():
    env = envs.make(
        TaskConfig("place"),
        obs_type="pixels_agent_pos",
        cameras=("front", "back"),
        image_size=WHOLE,
    )
    observation, _ = env.reset(seed=names.VALIDATION_SEED)
    wide, square = (AimedAgent(kind(), TruthDetector(env)) for kind in (WideAgent, Looking))
    for view in VIEWS[:2]:
        one, other = (np.array(agent.crops(observation)[view]) for agent in (wide, square))
        assert one.shape == (SIDE, 128, 3) and other.shape == (SIDE, SIDE, 3)
        apart = one[:, 16:-16].astype(int) - other  # about the same place, but for rounding
        assert np.abs(apart).max() <= 1


def test_an_agent_that_needs_depth_is_refused(folder):
    with pytest.raises(InputError, match="needs their depth"):
        aimed(replace(spec_of(), make=DeepAgent), folder).make_agent()


def test_the_released_detector_is_that_of_the_folder_that_is_used_instead(
    folder, tmp_path, monkeypatch
):
    ours = detector_folder(RELEASED)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "tried"))
    assert detector_folder(RELEASED) == ours  # policies alone were built there
    monkeypatch.setenv(VARIABLE, str(folder.parent))
    assert detector_folder(RELEASED) == folder
    assert aimed(spec_of(), RELEASED).run.detector == read_card(folder).weights_sha256
