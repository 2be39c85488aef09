"""Datasets: episodes rendered from demonstrations, in LeRobot's v3 format.

    from surgicai_vision.dataset import check_dataset, open_dataset, render_demos

`rendering` turns states into images (one job an episode), `writing` assembles the episodes with
LeRobot's own metadata writer, `reading` opens a dataset without torch, `checking` verifies one,
`repairing` keeps the longest verified prefix of a broken one, `viewing` makes one of fewer views or
of videos.
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
    "open_dataset",
    "render_demos",
    "convert_dataset",
]
