"""Visibility: at the end of a successful subtask the views of the world show the needle.

The views are "front", "back", both eyes of the endoscope, and the eyes' crops around the active
arm, where the needle is larger.
"""

import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.names import ACTIVE_ARM, ENDOSCOPE_CAMERAS, PARTS
from surgicai_vision.demos.expert import Expert

SEEDS = range(8)
PIXELS = 25
"""Least number of needle pixels at 224 × 224."""


@pytest.mark.parametrize("task", ["grasp", "place", "insert", "handoff"])
def test_the_needle_is_seen_at_the_end(task):
    env = envs.make(TaskConfig(task=task))
    crops = [f"{eye}_{ACTIVE_ARM[task]}" for eye in ENDOSCOPE_CAMERAS]
    counts = {view: [] for view in ("front", "back", *ENDOSCOPE_CAMERAS, *crops)}
    for seed in SEEDS:
        env.reset(seed=seed)
        expert, info, ended = Expert(env), {}, False
        while not ended:
            _, _, terminated, truncated, info = env.step(expert.action())
            ended = terminated or truncated
        assert info["is_success"]
        for camera, seen in counts.items():
            image = env.image(camera, (224, 224), "segmentation")
            seen.append(int((image == PARTS.index("needle")).sum()))
    env.close()
    for camera, seen in counts.items():
        assert min(seen) >= PIXELS, (camera, seen)
    for eye, crop in zip(ENDOSCOPE_CAMERAS, crops, strict=True):
        assert min(counts[crop]) > 2 * min(counts[eye])
