"""Contact sheets: a title fits on its sheet."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from surgicai_vision.envs import contact_sheet


@pytest.mark.parametrize("columns", [1, 4])
@pytest.mark.parametrize(
    "title",
    [
        "grasp",
        "imagenet-lite-early-front_psm2+back_psm2-spatial-best+map_shift=2: grasp, start 900000",
        "x" * 80,
    ],
)
def test_a_title_lies_within_its_sheet(columns, title):
    image = np.zeros((8, 8, 3), np.uint8)
    figure = contact_sheet.sheet([("a", [image] * columns)], ["view"] * columns, title)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    box = figure._suptitle.get_window_extent(canvas.get_renderer())
    assert box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height
    assert figure.get_suptitle().replace("\n", "").replace(" ", "") == title.replace(" ", "")
