"""The feature cache: encode once, resume, never use an outdated entry."""

import errno
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import FakeData
from tiny_encoder import TINY

from encoders.random_resnet import CARD
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, SurgicaiError, UnknownName
from surgicai_vision.core.files import write_json
from surgicai_vision.dataset.subset import DatasetSubset
from surgicai_vision.features import cache as module
from surgicai_vision.features import encoders
from surgicai_vision.features.cache import encode, entry_key, list_cache, prune_cache


@dataclass
class FakeDataset(FakeData):
    """Tiny frames whose mean is their index."""

    length: int = 23
    fingerprint: str = "data"
    views: tuple[str, ...] = ("front", "back")
    reads: int = 0
    config: TaskConfig = TaskConfig()
    task: str = "grasp"
    image_size: int = 4

    def frames(self, view: str, start: int, stop: int) -> np.ndarray:
        self.reads += stop - start
        values = np.arange(start, stop) + 100 * self.views.index(view)
        return np.broadcast_to(values[:, None, None, None], (stop - start, 4, 4, 3)).astype(
            np.uint8
        )


class FakeEncoder:
    """Gives three numbers per frame; counts its frames."""

    card, pool, dim, shape = CARD, "global", 3, (3,)

    def __init__(
        self, fingerprint: str = "encoder", fail_after: int | None = None, value: float = 0.0
    ):
        self.fingerprint, self.weights_sha256, self.seen = fingerprint, fingerprint, 0
        self.fail_after, self.value = fail_after, value

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        if self.fail_after is not None and self.seen >= self.fail_after:
            raise KeyboardInterrupt
        self.seen += len(frames)
        return frames[:, 0, 0, :].astype(np.float32) + self.value


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CHUNK", 5)


def expected(length: int = 23, offset: int = 0) -> np.ndarray:
    return np.tile(np.arange(length)[:, None] + offset, 3).astype(np.float16)


def test_rows_are_aligned_with_the_frames(tmp_path: Path) -> None:
    entry = encode(FakeDataset(), "back", FakeEncoder(), tmp_path)
    np.testing.assert_array_equal(entry.rows, expected(offset=100))
    assert entry.rows.dtype == np.float16 and not entry.rows.flags.writeable
    assert (entry.view, entry.dim, entry.encoded) == ("back", 3, 23)
    assert entry.manifest["card"]["name"] == "random"


def test_encoding_twice_does_nothing(tmp_path: Path) -> None:
    encode(FakeDataset(), "front", FakeEncoder(), tmp_path)
    dataset, encoder = FakeDataset(), FakeEncoder()
    again = encode(dataset, "front", encoder, tmp_path)
    assert again.encoded == 0 and encoder.seen == 0 and dataset.reads == 0
    np.testing.assert_array_equal(again.rows, expected())


def test_interrupted_encoding_resumes(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        encode(FakeDataset(), "front", FakeEncoder(fail_after=10), tmp_path)
    assert [entry.manifest for entry in list_cache(tmp_path)] == [None]
    encoder, steps = FakeEncoder(), []
    entry = encode(
        FakeDataset(), "front", encoder, tmp_path, lambda done, total: steps.append((done, total))
    )
    assert encoder.seen == 13 and steps[0] == (10, 23) and steps[-1] == (23, 23)
    np.testing.assert_array_equal(entry.rows, expected())


def test_damaged_progress_starts_over(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        encode(FakeDataset(), "front", FakeEncoder(fail_after=10), tmp_path)
    folder = list_cache(tmp_path)[0].folder
    (folder / "features.npy").write_bytes(b"torn")
    entry = encode(FakeDataset(), "front", FakeEncoder(), tmp_path)
    np.testing.assert_array_equal(entry.rows, expected())


@pytest.mark.parametrize("change", ["dataset", "view", "encoder"])
def test_a_change_never_meets_an_old_entry(tmp_path: Path, change: str) -> None:
    first = encode(FakeDataset(), "front", FakeEncoder(), tmp_path)
    dataset = replace(FakeDataset(), fingerprint="other") if change == "dataset" else FakeDataset()
    encoder = FakeEncoder("other" if change == "encoder" else "encoder")
    second = encode(dataset, "back" if change == "view" else "front", encoder, tmp_path)
    assert second.folder != first.folder and second.encoded == 23


def test_wrong_inputs(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="front"):
        encode(FakeDataset(), "frnt", FakeEncoder(), tmp_path)
    with pytest.raises(InputError, match="no frames"):
        encode(FakeDataset(length=0), "front", FakeEncoder(), tmp_path)
    with pytest.raises(SurgicaiError, match="not finite"):
        encode(FakeDataset(), "front", FakeEncoder(value=np.inf), tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        encode(FakeDataset(), "front", FakeEncoder(), tmp_path / "file")


def test_values_beyond_float16_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SurgicaiError, match="not finite"):
        encode(FakeDataset(), "front", FakeEncoder(value=1e6), tmp_path)


def test_a_damaged_entry_is_named(tmp_path: Path) -> None:
    entry = encode(FakeDataset(), "front", FakeEncoder(), tmp_path)
    path = entry.folder / "features.npy"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(BadFile, match="delete that folder"):
        encode(FakeDataset(), "front", FakeEncoder(), tmp_path)


@pytest.mark.parametrize("killed", [False, True])
def test_every_block_is_taken_before_a_row_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: bool
) -> None:
    long = FakeDataset(length=20_000)
    monkeypatch.setattr(module, "CHUNK", 10_000)
    if killed:  # by a release that reserved no blocks: the file is sparse
        folder = tmp_path / "features" / entry_key(long, "front", FakeEncoder())
        folder.mkdir(parents=True)
        np.lib.format.open_memmap(folder / "features.npy", "w+", np.float16, (20_000, 3))
        write_json(folder / "progress.json", {"rows": 0})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space")

    with monkeypatch.context() as disk:
        disk.setattr(os, "posix_fallocate", full)
        encoder = FakeEncoder()
        with pytest.raises(OSError, match="no space"):
            encode(long, "front", encoder, tmp_path)
        assert encoder.seen == 0
    with pytest.raises(KeyboardInterrupt):
        encode(long, "front", FakeEncoder(fail_after=0), tmp_path)
    (path,) = tmp_path.rglob("features.npy")
    assert path.stat().st_blocks * 512 >= path.stat().st_size > 2 * 3 * 20_000
    np.testing.assert_array_equal(
        encode(long, "front", FakeEncoder(), tmp_path).rows[:250], expected(250)
    )


@pytest.mark.parametrize(
    "manifest", ["{", "{}", "[]", "[" * 100_000, {"shape": "x"}, {"length": 2.0}, {"dim": 10**400}]
)
def test_a_damaged_manifest_is_listed_and_pruned(tmp_path: Path, manifest: object) -> None:
    entry = encode(FakeDataset(), "front", FakeEncoder(), tmp_path)
    text = json.dumps({**entry.manifest, **manifest}) if isinstance(manifest, dict) else manifest
    (entry.folder / "manifest.json").write_text(str(text))
    stray = entry.folder.parent / "notes.txt"
    stray.write_text("mine")
    with pytest.raises(BadFile, match="delete that folder"):
        encode(FakeDataset(), "front", FakeEncoder(), tmp_path)
    assert [found.manifest for found in list_cache(tmp_path)] == [None]
    assert len(prune_cache(tmp_path, keep_datasets={"data"})) == 1
    assert list(entry.folder.parent.iterdir()) == [stray]


def test_list_and_prune(tmp_path: Path) -> None:
    assert list_cache(tmp_path / "none") == []
    encode(FakeDataset(), "front", FakeEncoder(), tmp_path)
    encode(FakeDataset(fingerprint="old"), "front", FakeEncoder(), tmp_path)
    with pytest.raises(KeyboardInterrupt):
        encode(FakeDataset(), "back", FakeEncoder(fail_after=5), tmp_path)
    assert sorted(bool(entry.manifest) for entry in list_cache(tmp_path)) == [False, True, True]
    removed = prune_cache(tmp_path, keep_datasets={"data"})
    assert len(removed) == 2
    (left,) = list_cache(tmp_path)
    assert left.manifest is not None and left.manifest["dataset"] == "data" and left.size > 0


def test_features_of_some_frames_of_a_dataset_are_kept_with_it(tmp_path: Path) -> None:
    for name in ("data", "old"):
        whole = FakeDataset(fingerprint=name)
        encode(
            DatasetSubset(whole, np.arange(0, 23, 5), {"stride": 5}),
            "front",
            FakeEncoder(),
            tmp_path,
        )
    assert len(prune_cache(tmp_path, keep_datasets={"data"})) == 1
    (left,) = list_cache(tmp_path)
    assert left.manifest is not None and left.manifest.get("whole") == "data"
    assert left.manifest["dataset"] != "data"


def test_frames_in_a_row_of_an_encoded_dataset_are_not_encoded_again(tmp_path: Path) -> None:
    whole = FakeDataset()
    first = DatasetSubset(whole, np.arange(9), {"episodes": 2})
    within = DatasetSubset(first, np.arange(3, 7), {"episodes": 1})
    spread = DatasetSubset(whole, np.arange(0, 23, 5), {"stride": 5})
    alone = encode(first, "front", FakeEncoder(), tmp_path / "alone").rows
    encode(whole, "front", FakeEncoder(), tmp_path)
    for part, rows in ((first, alone), (within, alone[3:7])):
        encoder = FakeEncoder()
        entry = encode(part, "front", encoder, tmp_path)
        assert (entry.encoded, encoder.seen) == (0, 0)
        assert entry.manifest["dataset"] == part.fingerprint
        np.testing.assert_array_equal(entry.rows, rows)
    assert encode(spread, "front", FakeEncoder(), tmp_path).encoded == 5, (
        "taken from the whole, these would be copied into memory"
    )
    assert encode(first, "back", FakeEncoder(), tmp_path).encoded == 9, "this view is not encoded"


def test_cache_root_follows_the_environment(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SURGICAI_VISION_CACHE", str(tmp_path))
    assert module.default_cache_root() == tmp_path
    monkeypatch.delenv("SURGICAI_VISION_CACHE")
    assert module.default_cache_root() == Path.home() / ".cache" / "surgicai-vision"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"build": lambda *_: 1 / 0}, "failed: ZeroDivisionError"),
        ({"build": lambda *_: None}, "builds None; its build must return"),
        ({"build": lambda card, _: (card, card)}, "builds .*must return its card and a torch"),
        ({"card": replace(TINY.card, dim=48)}, r"gives features of shape \(8,\), .*dim 48"),
    ],
)
def test_an_encoder_that_cannot_be_used_is_named(change: dict[str, Any], message: str) -> None:
    encoders.register_encoder("odd", replace(TINY, **change), "theirs")
    try:
        with pytest.raises(InputError, match=rf"^The encoder 'odd' of 'theirs' {message}"):
            encoders.load_encoder("odd", device="cpu")
    finally:
        encoders.ENCODERS.unregister("odd")


@pytest.mark.parametrize("build", [TINY.build, lambda _, path: TINY.build(TINY.card, path)])
def test_an_encoder_has_the_name_it_is_offered_under(build: Any) -> None:
    encoders.register_encoder("odd", replace(TINY, build=build), "theirs")
    try:
        card = encoders.load_encoder("odd", device="cpu").card
        assert (encoders.encoder_card("odd").name, card.name) == ("odd", "odd")
    finally:
        encoders.ENCODERS.unregister("odd")
