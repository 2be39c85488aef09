"""Datasets: episodes rendered from demonstrations, in LeRobot's v3 format.

    from surgicai_vision.dataset import check_dataset, open_dataset, render_demos

`render` turns states into images (one job per episode), `writer` assembles the episodes with
LeRobot's metadata, `reader` opens a dataset without torch, `subset` selects some of its frames,
`check` verifies it, `convert` keeps some of its views or stores them as videos, `hub` shares it.
The distribution lerobot_salvage repairs a broken dataset.
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
