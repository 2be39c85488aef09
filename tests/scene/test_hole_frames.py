"""The frames of holes: `height` and `local` agree with the rotation."""

import numpy as np
import pytest

from surgicai_vision.scene.holes import Hole


@pytest.mark.parametrize("tilt", [-0.8, 0.0, 1.2])
@pytest.mark.parametrize("turn", [-0.3, 0.0, 2.0])
def test_height_and_local_agree_with_the_rotation(tilt: float, turn: float) -> None:
    hole = Hole((0.01, -0.02, 0.07), tilt, turn)
    rotation = hole.rotation
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    rng = np.random.default_rng(1)
    for _ in range(20):
        point = tuple(rng.normal(size=3).tolist())
        local = rotation.T @ (np.array(point) - hole.centre)
        assert hole.local(point) == pytest.approx(tuple(local), abs=1e-12)
        assert hole.height(point) == pytest.approx(local[2], abs=1e-12)
    assert hole.normal == pytest.approx(tuple(rotation[:, 2]))
