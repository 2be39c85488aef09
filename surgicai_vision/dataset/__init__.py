"""Datasets: episodes rendered from demonstrations, in LeRobot's v3 format.

    from surgicai_vision.dataset import check_dataset, open_dataset, render_demos

`rendering` turns states into pictures (one job an episode), `writing` assembles the episodes with LeRobot's
own metadata writer, `reading` opens a dataset without torch, `checking` verifies one.
"""

from surgicai_vision.dataset.checking import CheckReport, check_dataset
from surgicai_vision.dataset.reading import Dataset, open_dataset
from surgicai_vision.dataset.rendering import DatasetSummary, render_demos

__all__ = ["CheckReport", "Dataset", "DatasetSummary", "check_dataset", "open_dataset", "render_demos"]
