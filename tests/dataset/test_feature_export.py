"""Datasets with features instead of images: accepted folders, and what a kill leaves."""

import numpy as np
import pytest

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.files import TEMPORARY
from surgicai_vision.dataset import feature_export, open_dataset, render_demos
from surgicai_vision.dataset.feature_export import export_features
from surgicai_vision.demos.record import record

ABOUT = {"encoder": "random", "views": ["back"], "weights_sha256": ""}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A dataset of one demonstration."""
    folder = tmp_path_factory.mktemp("export")
    record(TaskConfig("grasp"), episodes=1, out=folder / "demos", context=RunContext(0))
    render_demos(
        folder / "demos", folder / "dataset", views=("back",), size=32, context=RunContext(0)
    )
    return open_dataset(folder / "dataset")


def test_an_empty_folder_is_taken_and_one_with_files_refused(dataset, tmp_path):
    rows = np.zeros((dataset.length, 2), np.float32)
    (tmp_path / "out").mkdir()
    export_features(dataset, [rows], ABOUT, tmp_path / "out")
    assert open_dataset(tmp_path / "out").length == dataset.length
    with pytest.raises(OutputExists, match="already holds files"):
        export_features(dataset, [rows], ABOUT, tmp_path / "out")


def test_an_export_is_not_what_was_rendered(dataset, tmp_path):
    rows = np.zeros((dataset.length, 2), np.float32)
    export_features(dataset, [rows], ABOUT, tmp_path / "out")
    demos = dataset.path.parent / "demos"
    with pytest.raises(OutputExists):
        render_demos(demos, tmp_path / "out", views=("back",), size=32, context=RunContext(0))


def test_what_a_kill_leaves_is_named_as_everything_that_may_be_deleted(
    dataset, tmp_path, monkeypatch
):
    found = []

    def assemble(shards, *arguments):
        found.extend(path.name for path in tmp_path.iterdir())

    monkeypatch.setattr(feature_export, "assemble", assemble)
    export_features(dataset, [np.zeros((dataset.length, 2), np.float32)], ABOUT, tmp_path / "out")
    assert len(found) == 1 and found[0].startswith(TEMPORARY)
