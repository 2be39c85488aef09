"""Datasets with features instead of images: accepted folders, and what a kill leaves."""

import multiprocessing
import os

import numpy as np
import pytest

from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.executor import RunContext
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


def test_an_export_that_was_killed_is_made_anew_and_leaves_nothing(dataset, tmp_path, monkeypatch):
    rows = np.zeros((dataset.length, 2), np.float32)
    given = (dataset, [rows], ABOUT, tmp_path / "out")
    with monkeypatch.context() as killed:
        killed.setattr(feature_export, "assemble", lambda *arguments: os._exit(9))
        process = multiprocessing.get_context("fork").Process(target=export_features, args=given)
        process.start()
        process.join()
    assert process.exitcode == 9 and list(tmp_path.iterdir())

    export_features(*given)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
