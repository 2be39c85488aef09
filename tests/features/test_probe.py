"""The linear probe: on features that hold the pose, on noise, and what it refuses."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import FakeData

from surgicai_vision.commands import folders
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError, UnknownName, check_name
from surgicai_vision.features.cache import Features
from surgicai_vision.features.probe import FRAMES, _Ridge, _targets, needle_pose, probe, spread
from surgicai_vision.scene import rotations
from surgicai_vision.scene.needle import HOME, TIP_ANGLE, point


def poses(episodes: int, frames: int, seed: int = 0) -> np.ndarray:
    """Poses (N, 7) of a needle that lies still, at a different place and angle in each episode."""
    generator = np.random.default_rng(seed)
    rows = []
    for _ in range(episodes):
        place = HOME + generator.uniform(-0.02, 0.02, 3)
        turn = rotations.rotvec_to_matrix([0, 0, generator.uniform(-0.5, 0.5)])
        rows += [np.concatenate([place, rotations.matrix_to_quaternion(turn)])] * frames
    return np.array(rows)


@dataclass
class Dataset(FakeData):
    """Episodes of a needle's poses, shown in one-pixel images."""

    pose: np.ndarray = field(default_factory=lambda: poses(20, 6))
    episodes: int = 20
    task: str = "grasp"
    fingerprint: str = "poses"
    views: tuple[str, ...] = ("front", "back")
    image_size: int = 32
    config: TaskConfig = field(default_factory=TaskConfig)

    def __post_init__(self) -> None:
        self.length = len(self.pose)
        self.episode_index = np.repeat(np.arange(self.episodes), self.length // self.episodes)

    def columns(self) -> dict[str, np.ndarray]:
        return {names.NEEDLE_POSE: self.pose.astype(np.float32)}

    def frames(self, view: str, start: int, stop: int) -> np.ndarray:
        place = (self.pose[start:stop, :3] - HOME) / 0.04 + 0.5
        return np.broadcast_to(
            (255 * place).astype(np.uint8)[:, None, None], (stop - start, 32, 32, 3)
        )


def features(rows: np.ndarray, dataset: Dataset, view: str = "front") -> Features:
    return Features(Path(), {"dataset": dataset.fingerprint, "view": view}, rows.astype(np.float16))


def test_features_that_hold_the_pose_are_read_and_noise_is_not() -> None:
    dataset = Dataset()
    position, rotation = _targets(dataset.pose)
    mixing = np.random.default_rng(1).normal(size=(9, 200))
    holding = np.concatenate([(position - position.mean(0)) * 50, rotation], axis=1) @ mixing
    found = probe(dataset, [features(holding, dataset)])
    assert found.n == 20 and found.frames == 120
    assert found.tip.median < 0.3 and found.angle.median < 1.0, found
    assert found.tip.low <= found.tip.median <= found.tip.high < 0.1 * found.tip.chance
    assert found.tip.chance > 10 and found.angle.chance > 5
    noise = probe(dataset, [features(np.random.default_rng(2).normal(size=(120, 200)), dataset)])
    assert noise.tip.median > 0.7 * noise.tip.chance


def test_features_that_are_constant_give_the_mean_pose() -> None:
    dataset = Dataset()
    found = probe(dataset, [features(np.ones((dataset.length, 8)), dataset)])
    assert found.tip.median == pytest.approx(found.tip.chance)
    assert found.angle.median == pytest.approx(found.angle.chance)


def test_an_episodes_identity_does_not_help() -> None:
    """Features that only identify the episode fit training episodes and fail on held-out ones."""
    dataset = Dataset()
    identity = np.eye(20)[dataset.episode_index]
    found = probe(dataset, [features(identity, dataset)])
    assert found.tip.median > 0.8 * found.tip.chance


def test_views_stand_side_by_side() -> None:
    dataset = Dataset()
    position, _ = _targets(dataset.pose)
    halves = [features((position[:, axes] - HOME[axes]) * 50, dataset) for axes in ([0, 1], [2])]
    alone, both = probe(dataset, halves[:1]), probe(dataset, halves)
    assert both.tip.median < 0.2 * alone.tip.median


def test_proprioception_places_what_a_crop_shows() -> None:
    """Features that place the tip relative to the jaws also need the position of the jaws."""
    generator = np.random.default_rng(3)
    dataset = Dataset()
    position, _ = _targets(dataset.pose)
    jaws = position + generator.normal(scale=0.02, size=position.shape)
    state = np.concatenate([jaws, np.zeros((len(jaws), 4))], axis=1)
    told = dataset.columns() | {names.STATE: state.astype(np.float32)}
    dataset.columns = lambda: told  # type: ignore[method-assign]
    mixing = generator.normal(size=(3, 200))
    crop = [features(50 * (position - jaws) @ mixing, dataset)]
    blind, alone = probe(dataset, [], proprioception=True), probe(dataset, crop)
    both = probe(dataset, crop, proprioception=True)
    assert both.tip.median < 0.1 * min(blind.tip.median, alone.tip.median)


def test_dual_ridge_is_ridge_in_closed_form() -> None:
    generator = np.random.default_rng(0)
    fitted, asked, target = (generator.normal(size=shape) for shape in ((30, 8), (5, 8), (30, 2)))
    penalty = 0.01
    mean, centre = fitted.mean(0), target.mean(0)
    centred = fitted - mean
    strength = penalty * np.trace(centred @ centred.T)
    weights = np.linalg.solve(
        centred.T @ centred + strength * np.eye(8), centred.T @ (target - centre)
    )
    ridge = _Ridge(fitted @ fitted.T, asked @ fitted.T)
    np.testing.assert_allclose(
        ridge.answer(target, penalty), (asked - mean) @ weights + centre, atol=1e-9
    )


def test_tip_is_where_the_needle_ends() -> None:
    pose = poses(1, 1)
    tip, _ = _targets(pose)
    np.testing.assert_allclose(
        tip[0], pose[0, :3] + rotations.quaternion_to_matrix(pose[0, 3:]) @ point(TIP_ANGLE)
    )


def test_frames_are_spread_over_every_episode() -> None:
    index = np.repeat(np.arange(4), [3, 1000, 1000, 1000])
    rows = spread(index, FRAMES)
    counts = np.bincount(index[rows])
    assert counts.tolist() == [3, 250, 250, 250] and len(set(rows.tolist())) == len(rows)
    assert rows[3] == 3 and rows[-1] == len(index) - 1


def test_what_cannot_be_probed_is_refused() -> None:
    dataset = Dataset()
    entry = features(np.zeros((120, 3)), dataset)
    with pytest.raises(InputError, match="at least 5"):
        probe(Dataset(poses(4, 6), 4), [entry])
    with pytest.raises(InputError, match="another dataset"):
        probe(Dataset(fingerprint="other"), [entry])
    with pytest.raises(InputError, match="at least one view"):
        probe(dataset, [])
    broken = Dataset()
    broken.pose[3, 0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        probe(broken, [entry])
    broken.columns = dict  # type: ignore[method-assign]
    with pytest.raises(UnknownName, match="needle_pose"):
        probe(broken, [entry])
    for axes in ({"needle_arc": "any"}, {"needle_size": 0.1}):
        varied = TaskConfig(randomisation=RandomisationConfig(**axes))
        with pytest.raises(InputError, match=f"shape varies in the dataset .{next(iter(axes))}"):
            probe(Dataset(config=varied), [entry])
    moved = TaskConfig(randomisation=RandomisationConfig(phantom_shift=5.0))
    assert len(needle_pose(Dataset(config=moved))) == 120


def test_verb_refuses_what_cannot_be_probed_before_it_encodes(
    tiny_encoder: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_dataset(*_: object) -> Dataset:
        return Dataset(poses(4, 6), 4)

    monkeypatch.setenv("SURGICAI_VISION_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(folders, "open_dataset", open_dataset)
    assert main(["probe", "--encoder", "tiny", "--out", str(tmp_path / "out")]) == 2
    assert not list(tmp_path.iterdir())


def test_verb_writes_a_row_a_view_set(
    tiny_encoder: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def open_dataset(folder: str | None, task: str, views: tuple[str, ...]) -> Dataset:
        for view in views:
            check_name("view of this dataset", view, Dataset.views)
        return Dataset()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SURGICAI_VISION_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(folders, "open_dataset", open_dataset)
    assert main(["probe", "--encoder", "tiny", "--view", "front,back", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [row["view"] for row in rows] == ["front", "back", "front+back"]
    stored = json.loads(
        (tmp_path / "outputs" / "probes" / "grasp-tiny-front+back" / "probe.json").read_text()
    )
    assert stored == rows and all(
        row["n"] == 20 and row["tip_mm"] < 0.5 * row["tip_mm_chance"] for row in rows
    )
    assert main(["probe", "--encoder", "tini"]) == 2
    assert "tiny" in capsys.readouterr().err
    assert main(["probe", "--encoder", "tiny", "--view", "wrist"]) == 2
