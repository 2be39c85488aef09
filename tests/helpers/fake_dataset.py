"""A dataset and its features in memory, for the tests of training."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.dataset.protocol import episode_bounds
from surgicai_vision.features.cache import Features

DIM = 12


class FakeData:
    """Base of the stand-ins for a dataset; each adds what its test reads."""

    fps = names.FPS
    path = Path("fake")
    views: tuple[str, ...]
    episode_index: np.ndarray

    @property
    def policy_views(self) -> tuple[str, ...]:
        return self.views

    @property
    def demonstration_index(self) -> np.ndarray:
        return self.episode_index

    def bounds(self) -> list[tuple[int, int]]:
        return episode_bounds(self.episode_index)


@dataclass
class FakeDataset(FakeData):
    """A dataset in memory.

    The action is a smooth function of the state, plus one of the features.
    """

    episodes: int = 5
    steps: int = 40
    config: TaskConfig = field(default_factory=TaskConfig)
    task: str = "grasp"
    views: tuple[str, ...] = ()
    image_size: int = 224
    fingerprint: str = "fake"

    def __post_init__(self) -> None:
        generator = np.random.default_rng(0)
        self.length = self.episodes * self.steps
        self.episode_index = np.repeat(np.arange(self.episodes), self.steps)
        self.rows = generator.normal(size=(self.length, DIM)).astype(np.float16)
        state = (generator.normal(size=(self.length, 7)) * 0.01).astype(np.float32)
        action = np.tanh(state * 100 + self.rows[:, :1]).astype(np.float32)
        self._columns = {names.STATE: state, names.ACTION: action}

    def columns(self) -> dict[str, np.ndarray]:
        return dict(self._columns)


def recorded(episodes: int = 5, steps: int = 40) -> FakeDataset:
    """Return a dataset with the time of its frames."""
    dataset = FakeDataset(episodes, steps)
    dataset._columns["timestamp"] = np.tile(np.arange(steps) / names.FPS, episodes)
    return dataset


def fake_procedures(episodes: int = 6, steps: int = 40) -> FakeDataset:
    """Return whole procedures whose arm poses encode the phase and the time since it began."""
    dataset = FakeDataset(episodes, 5 * steps, TaskConfig(names.SUTURE), names.SUTURE)
    phase = np.tile(np.repeat(np.arange(5), steps), episodes)
    since = np.tile(np.arange(steps), 5 * episodes)
    arms = np.random.default_rng(2).normal(size=(dataset.length, 14)) * 0.1
    arms[:, :5] += np.eye(5)[phase]
    arms[:, 5] += since / steps
    seconds = np.tile(np.arange(5 * steps) / names.FPS, episodes)
    dataset._columns |= {
        names.PHASE: phase,
        names.SUCCESS: np.tile(np.arange(5 * steps) == 5 * steps - 1, episodes),
        names.BOTH_ARMS: arms.astype(np.float32),
        "timestamp": seconds.astype(np.float32),
        "frame_index": np.tile(np.arange(5 * steps), episodes),
    }
    return dataset


def features_of(fake: FakeDataset, view: str = "back", **changes: object) -> Features:
    card = dict.fromkeys(
        ("input_size", "input_range", "mean", "std", "interpolation", "channel_order"), 0
    )
    manifest = {
        "dataset": fake.fingerprint,
        "view": view,
        "encoder": "fake",
        "card": card,
        "pool": "global",
        "encoder_fingerprint": "f",
        "weights_sha256": "w",
        "dim": DIM,
        "shape": [DIM],
        **changes,
    }
    return Features(Path("."), manifest, fake.rows)
