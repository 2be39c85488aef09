"""The released code's deviations: each is a switch, off by default, and each has its effect."""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from encoders.base import Encoder
from encoders.card import Plugin
from encoders.clip import CLIP
from encoders.imagenet import IMAGENET
from encoders.r3m import R3M, R3M_18
from encoders.released import changed, drifted
from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.core import names
from surgicai_vision.core.config import DEVIATIONS, Deviations, TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.evaluation import policy_spec, run
from surgicai_vision.evaluation.agents import NoisyAgent, PolicyAgent, ZeroAgent
from surgicai_vision.features import encoders
from surgicai_vision.training import policies, reproduction
from surgicai_vision.training.checkpoint import ENCODER_STATISTICS, read_checkpoint

QUIET = QuietConsole().stage


@dataclass
class Images:
    """A dataset of four episodes of coloured noise."""

    config: TaskConfig = field(default_factory=TaskConfig)
    task: str = "grasp"
    views: tuple[str, ...] = ("back",)
    image_size: int = 32
    length: int = 24
    fingerprint: str = "coloured noise"

    def __post_init__(self) -> None:
        self.episode_index = np.repeat(np.arange(4), 6)
        self._frames = np.random.default_rng(0).integers(0, 256, (self.length, 32, 32, 3), np.uint8)

    def frames(self, view: str, start: int, stop: int) -> np.ndarray:
        return self._frames[start:stop]

    def columns(self) -> dict[str, np.ndarray]:
        noise = np.random.default_rng(1).normal(size=(self.length, 14)).astype(np.float32)
        return {names.STATE: noise[:, :7], names.ACTION: np.tanh(noise[:, 7:])}


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the encoder "tiny", and drift in two steps."""
    monkeypatch.setattr(encoders, "ENCODERS", {**encoders.ENCODERS, "tiny": "tiny_encoder:TINY"})
    monkeypatch.setattr(reproduction, "BATCH", 4)
    monkeypatch.setattr(reproduction, "STEPS", 2)


def test_all_are_off_by_default_and_on_in_the_released_recipe() -> None:
    assert policies.load_recipe("bc", "paper").deviations == Deviations()
    recipe = policies.load_recipe("bc", "released")
    assert recipe.deviations == Deviations(**dict.fromkeys(DEVIATIONS, True))
    assert (recipe.hidden, recipe.learning_rate, recipe.epochs, recipe.split) == (
        (256,),
        1e-4,
        40,
        "transition",
    )


def test_each_is_switched_alone() -> None:
    cell = Cell("grasp", "random", ("back",), deviations=("bgr",))
    recipe = policies.load_recipe("bc", cell.recipe, cell.changes)
    assert recipe.deviations == Deviations(bgr=True)
    assert cell.name == "random-back-paper+bgr"
    none = Cell("grasp", "random", ("back",), recipe="released", deviations=())
    assert policies.load_recipe("bc", none.recipe, none.changes).deviations == Deviations()
    with pytest.raises(UnknownName, match="bgr"):
        Cell("grasp", "random", ("back",), deviations=("brg",))


def colour(*rgb: int) -> np.ndarray:
    return np.broadcast_to(np.array(rgb, np.uint8), (1, 224, 224, 3))


def test_bgr_shows_blue_for_red(tiny: None) -> None:
    plain = encoders.load_encoder("tiny")
    swapped = encoders.load_encoder("tiny", deviations=Deviations(bgr=True))
    np.testing.assert_array_equal(swapped(colour(200, 30, 10)), plain(colour(10, 30, 200)))
    assert not np.array_equal(swapped(colour(200, 30, 10)), plain(colour(200, 30, 10)))
    assert (
        swapped.fingerprint != plain.fingerprint and swapped.weights_sha256 == plain.weights_sha256
    )


def seen(plugin: Plugin, deviations: Deviations, frames: np.ndarray) -> np.ndarray:
    """What a network is fed under `deviations`."""
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten())
    return (
        Encoder(changed(plugin, plugin.card, deviations), network, dtype=torch.float32)
        .preprocess(frames)
        .numpy()
    )


def test_r3m_normalises_twice() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 224, 224, 3), np.uint8)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    once = (frames / 255 - mean) / std
    twice = (once / 255 - mean) / std
    for plugin in (R3M, R3M_18):
        np.testing.assert_allclose(
            seen(plugin, Deviations(), frames).transpose(0, 2, 3, 1), once, atol=1e-5
        )
        got = seen(plugin, Deviations(preprocessing=True), frames).transpose(0, 2, 3, 1)
        np.testing.assert_allclose(got, twice, atol=1e-5)


def test_clip_gets_the_statistics_of_imagenet_and_imagenet_keeps_its_own() -> None:
    deviations = Deviations(preprocessing=True)
    assert changed(CLIP, CLIP.card, deviations).mean == IMAGENET.card.mean != CLIP.card.mean
    assert changed(CLIP, CLIP.card, deviations).std == IMAGENET.card.std != CLIP.card.std
    assert changed(IMAGENET, IMAGENET.card, deviations) == IMAGENET.card


def test_noise_is_that_of_the_encoder_on_translations_alone() -> None:
    noises = {
        name: encoders.released_noise(name)
        for name in ("r3m", "clip", "imagenet", "random", "imagenet-lite")
    }
    assert noises == {"r3m": 0.1, "clip": 0.4, "imagenet": 0.5, "random": 0.0, "imagenet-lite": 0.0}
    agent = NoisyAgent(ZeroAgent(), 0.4)
    agent.begin(0, None, 900_000)
    actions = np.concatenate([agent.act([0], [None], [None]) for _ in range(300)])
    assert 0.35 < np.abs(actions[:, :3]).max() <= 0.4
    assert not actions[:, 3:].any()
    again = NoisyAgent(ZeroAgent(), 0.4)
    again.begin(3, None, 900_000)
    np.testing.assert_array_equal(again.act([3], [None], [None])[0], actions[0])


def test_three_evaluations_are_three_rounds_of_new_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[int] = []

    def evaluate(
        make: object, config: TaskConfig, seeds: range, **_: object
    ) -> list[SimpleNamespace]:
        taken.extend(seeds)
        return [SimpleNamespace(row=SimpleNamespace(success=seed % 2 == 0)) for seed in seeds]

    monkeypatch.setattr(run, "evaluate", evaluate)
    monkeypatch.setattr(
        run, "write_evaluation", lambda out, episodes, about: {"stored": about["rounds"]}
    )
    subject = policy_spec.Subject("policy", TaskConfig(), ZeroAgent, rounds=3)
    result = run.evaluate_into(tmp_path, subject, range(10, 15))
    assert taken == list(range(10, 25))
    assert result == {"rounds": [3, 2, 3], "stored": [3, 2, 3]}


def test_drift_moves_statistics_alone_and_needs_batch_norm() -> None:
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    drifted(network, [torch.randn(4, 3, 8, 8) + 5.0])
    moved = {
        name for name, value in network.state_dict().items() if not torch.equal(value, before[name])
    }
    assert moved == {"1.running_mean", "1.running_var", "1.num_batches_tracked"}
    with pytest.raises(InputError, match="no BatchNorm"):
        drifted(torch.nn.Linear(2, 2), [])


def test_a_drifted_encoder_comes_back_with_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny: None
) -> None:
    monkeypatch.setenv("SURGICAI_VISION_CACHE", str(tmp_path / "cache"))
    switches = ("batch_norm_drift", "bgr", "action_noise", "three_evaluations")
    cell = Cell("grasp", "tiny", ("back",), epochs=1, deviations=switches)
    train_cell(cell, Images(), tmp_path / "policy", QUIET)
    checkpoint = read_checkpoint(tmp_path / "policy")
    assert checkpoint.encoder is not None
    plain = encoders.load_encoder("tiny")
    assert checkpoint.encoder.weights_sha256 != plain.weights_sha256
    encoder = policies.load_encoder_of(checkpoint)
    assert encoder.weights_sha256 == checkpoint.encoder.weights_sha256
    assert encoder.card.channel_order == "BGR"
    subject = policy_spec.checkpoint_subject(tmp_path / "policy")
    assert subject.rounds == 3 and isinstance(subject.make_agent(), NoisyAgent)
    (tmp_path / "policy" / ENCODER_STATISTICS).write_bytes(b"torn")
    with pytest.raises(BadFile, match="safetensors"):
        policies.load_encoder_of(checkpoint)


def test_a_paper_policy_is_evaluated_as_ever(tmp_path: Path) -> None:
    cell = Cell("grasp", None, (), epochs=1)
    train_cell(cell, Images(), tmp_path / "policy", QUIET)
    subject = policy_spec.checkpoint_subject(tmp_path / "policy")
    assert subject.rounds == 1 and type(subject.make_agent()) is PolicyAgent
    assert not (tmp_path / "policy" / ENCODER_STATISTICS).exists()
