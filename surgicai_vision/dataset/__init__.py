"""Datasets: episodes rendered from demonstrations, in LeRobot's v3 format.

    from surgicai_vision.dataset import check_dataset, open_dataset, render_demos

`render` turns states into images (one job an episode), `writer` assembles the episodes with
LeRobot's metadata, `reader` opens a dataset without torch, `subset` selects some of its frames,
`check` verifies one, `convert` takes some of its views or stores them as videos, `hub` shares one.
Repair of a broken one: the distribution lerobot_salvage.
"""

from surgicai_vision.dataset.check import CheckReport, check_dataset
from surgicai_vision.dataset.convert import DatasetSummary, convert_dataset
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.dataset.reader import RenderedDataset, open_dataset
from surgicai_vision.dataset.render import render_demos

__all__ = [
    "CheckReport",
    "Dataset",
    "DatasetSummary",
    "RenderedDataset",
    "check_dataset",
    "convert_dataset",
    "open_dataset",
    "render_demos",
]
