"""LeRobot's own visualiser shows our datasets: what it logs is what the dataset holds."""

import numpy as np
import pytest
from fake_demos import render_with_fake_env, write_demos

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset.reader import open_dataset
from surgicai_vision.dataset.render import render_demos

rerun = pytest.importorskip("rerun", reason="no rerun here: it comes with the extra viz")


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    config = TaskConfig("grasp")
    render_with_fake_env(monkeypatch, config)
    demos = write_demos(tmp_path / "demos", config, [0, 1])
    render_demos(
        demos, tmp_path / "set", views=("front", "back"), size=48, depth=True, context=RunContext(0)
    )
    return open_dataset(tmp_path / "set")


def test_the_visualiser_logs_every_frame_of_an_episode(dataset, tmp_path, monkeypatch):
    from lerobot.datasets import LeRobotDataset
    from lerobot.scripts.lerobot_dataset_viz import visualize_dataset

    logged = {}
    log = rerun.log

    def record(path, entity):
        logged.setdefault(path, []).append(entity)
        log(path, entity)

    monkeypatch.setattr(rerun, "log", record)
    theirs = LeRobotDataset("local/handoff", root=dataset.path, episodes=[1])
    file = visualize_dataset(theirs, 1, save=True, output_dir=tmp_path / "rrd")
    assert file.stat().st_size > 10_000
    start, stop = dataset.bounds()[1]
    for view in dataset.views:
        images = logged[names.image_key(view)]
        assert len(images) == stop - start
        truth = dataset.frames(view, start, stop)
        for entity, frame in zip(images, truth, strict=True):
            shown = np.array(entity.buffer.as_arrow_array()[0].as_py(), np.uint8)
            np.testing.assert_array_equal(shown.reshape(frame.shape), frame)
        kinds = {type(entity) for entity in logged[names.depth_key(view)]}
        assert kinds == {rerun.DepthImage}, "depth is shown as depth"
    assert len(logged[names.ACTION]) == len(logged["state"]) == stop - start
