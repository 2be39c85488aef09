"""Averaged images: noise falls where a scene stands still, and what moves is never smeared."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from policies.base import Recipe
from policies.hlp import HLPRecipe
from surgicai_vision.core.config import TaskConfig, to_identity
from surgicai_vision.core.errors import InputError
from surgicai_vision.detection.card import DetectorCard
from surgicai_vision.detection.detector import write_detector
from surgicai_vision.detection.network import JawNetwork
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.aimed_agent import AimedAgent, aimed
from surgicai_vision.evaluation.denoised_agent import DenoisedAgent, StillMean
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.robustness import shifted
from surgicai_vision.evaluation.robustness.corrupted_agent import CorruptedAgent
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.training.run_config import OWN, RunConfig

SIGMA = 32.0
"""Noise of axis `noise` at half strength [grey levels]."""


def scene(square_at=20):
    """A grey image with a bright square, (96, 128, 3)."""
    image = np.full((96, 128, 3), 110.0)
    image[40:56, square_at : square_at + 16] = 220.0
    return image


def noisy(image, rng, sigma=SIGMA):
    return np.clip(image + rng.normal(0.0, sigma, image.shape), 0, 255).astype(np.uint8)


def error(image, truth):
    """Root mean square error [grey levels]."""
    return float(np.sqrt(np.mean((image.astype(float) - truth) ** 2)))


@pytest.mark.parametrize("frames", [2, 6])
def test_noise_falls_with_the_root_of_the_frames_and_no_further(frames):
    rng = np.random.default_rng(0)
    truth, mean = scene(), StillMean(frames)
    one = error(noisy(truth, rng), truth)
    errors = [error(mean.updated(noisy(truth, rng)), truth) for _ in range(4 * frames)]
    assert errors[0] == pytest.approx(one, rel=0.05), "the first image is shown as it is"
    # A running mean with weight 1/n for the newest image: variance 1/(2n - 1) of one image's.
    least = one / np.sqrt(2 * frames - 1)
    assert least * 0.9 < errors[-1] < one / np.sqrt(frames) * 1.15
    assert np.all(np.array(errors[frames:]) < one * 0.8)


def test_images_without_noise_are_shown_as_they_are():
    image = scene().astype(np.uint8)
    mean = StillMean(6)
    for _ in range(5):
        assert np.array_equal(mean.updated(image), image)


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_what_moves_is_shown_where_it_is_now(sigma):
    rng = np.random.default_rng(1)
    mean = StillMean(6)
    for _ in range(8):
        mean.updated(noisy(scene(20), rng, sigma))
    now = noisy(scene(60), rng, sigma)
    shown = mean.updated(now)
    assert np.array_equal(shown[42:54, 22:34], now[42:54, 22:34]), "where the square was"
    assert np.array_equal(shown[42:54, 62:74], now[42:54, 62:74]), "where it is"
    assert error(shown[:30], scene(60)[:30]) < max(1.0, 0.6 * sigma), "the rest stood still"


def test_one_frame_is_no_filter():
    rng = np.random.default_rng(2)
    mean = StillMean(1)
    for _ in range(3):
        image = noisy(scene(), rng)
        assert np.array_equal(mean.updated(image), image)


class Looking(Agent):
    """Keeps what it sees of each slot, and does nothing."""

    name = "looking"
    cameras = ("front_psm2", "wrist_psm2")
    image_size = 64

    def __init__(self):
        self.seen = {}

    def reset(self, slot, robot, seed):
        self.seen[slot] = []

    def act(self, slots, robots, observations):
        for slot, seen in zip(slots, observations, strict=True):
            self.seen[slot].append({key: np.array(seen[key]) for key in seen})
        return np.zeros((len(slots), 7), np.float32)


def test_slots_are_apart_and_forget_at_the_next_episode():
    rng = np.random.default_rng(3)
    agent = Looking()
    wrapped = DenoisedAgent(agent, 6)

    def step(*slots):
        images = {slot: {key: noisy(scene(), rng) for key in agent.cameras} for slot in slots}
        told = [{**images[slot], "agent_pos": np.full(7, float(slot))} for slot in slots]
        wrapped.act(slots, [None] * len(slots), told)
        return images

    for slot in (0, 1):
        wrapped.reset(slot, None, 0)
    for _ in range(3):
        step(0)
    images = step(0, 1)
    assert np.array_equal(agent.seen[1][0]["front_psm2"], images[1]["front_psm2"]), "its first"
    assert agent.seen[1][0]["agent_pos"][0] == 1.0
    assert error(agent.seen[0][-1]["wrist_psm2"], scene()) < 0.7 * SIGMA
    for forget in (lambda: wrapped.reset(0, None, 1), lambda: wrapped.restart(0)):
        forget()
        images = step(0)
        assert np.array_equal(agent.seen[0][-1]["front_psm2"], images[0]["front_psm2"])


def test_features_of_averaged_images_are_not_shared():
    shared = []

    class Sharing(Looking):
        def share(self, features):
            shared.append(features)

    DenoisedAgent(Sharing(), 6).share({})
    assert not shared


def test_whole_images_are_averaged_before_crops_are_cut(tmp_path):
    card = DetectorCard(("front", "back"), "", 0, 0, 0, {"front": 0.0, "back": 0.0}, "")
    write_detector(tmp_path / "detector", card, JawNetwork(2))
    run = RunConfig(TaskConfig("grasp", max_steps=4), OWN, Looking.cameras, policy="looking")
    spec = PolicySpec(run, functools.partial(DenoisedAgent, Looking(), 6))
    made = shifted(aimed(spec, tmp_path / "detector"), "noise", 0.5).make()
    kinds = []
    while hasattr(made, "agent"):
        kinds.append(type(made))
        made = made.agent
    assert kinds == [CorruptedAgent, DenoisedAgent, AimedAgent]


def test_noise_of_a_camera_is_averaged_in_an_episode():
    looking = Looking()
    config = TaskConfig("grasp", max_steps=6)
    run = RunConfig(config, OWN, Looking.cameras, policy="looking")
    seen = {}
    for name, make, noise in (
        ("clean", lambda: looking, 0.0),
        ("noisy", lambda: looking, 0.5),
        ("averaged", lambda: DenoisedAgent(looking, 6), 0.5),
    ):
        spec = shifted(PolicySpec(run, make), "noise", noise)
        evaluate(spec.make, spec.config, [0], workers=1)
        seen[name] = looking.seen[0]
    clean = seen["clean"]
    last = [error(seen[name][-1]["front_psm2"], clean[-1]["front_psm2"]) for name in seen]
    assert last[0] == 0.0
    assert last[2] < 0.7 * last[1], "the arms stand still"
    first = [seen[name][0]["front_psm2"] for name in ("noisy", "averaged")]
    assert np.array_equal(*first)


def test_a_recipe_averages_at_least_one_image():
    assert "denoise" not in to_identity(Recipe())
    assert to_identity(replace(Recipe(), denoise=6))["denoise"] == 6
    with pytest.raises(InputError, match=r"^denoise is 0"):
        Recipe(denoise=0)
    with pytest.raises(InputError, match="leave 'denoise' at 1"):
        HLPRecipe(denoise=6)


def test_a_checkpoint_is_told_to_average_by_the_command_that_runs_it():
    spec = open_policy("released:grasp", changes=("denoise=6",))
    assert spec.name.endswith("-acting+denoise=6")
    agent = spec.make_agent()
    assert isinstance(agent, DenoisedAgent) and agent.frames == 6
    assert not isinstance(open_policy("released:grasp").make_agent(), DenoisedAgent)
