"""Rendering: the laws of images, on a tiny scene whose answers are known."""

import multiprocessing
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from small_scene import BALL_RADIUS, PLANE_DISTANCE, small_spec

from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.names import MODALITIES, PARTS
from surgicai_vision.scene import rendering
from surgicai_vision.scene.cameras import extrinsics, intrinsics
from surgicai_vision.scene.rendering import FrameRenderer, parts_of_geoms, renderer_string

SIZE = (96, 128)
SHAPES = {"rgb": (*SIZE, 3), "depth": (*SIZE, 1), "segmentation": (*SIZE, 1)}
TYPES = {"rgb": np.uint8, "depth": np.float32, "segmentation": np.uint8}


@pytest.fixture
def model():
    return small_spec().compile()


@pytest.fixture
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


@pytest.fixture(params=["fast", "high"])
def renderer(request, model):
    with FrameRenderer(model, *SIZE, quality=request.param) as renderer:
        yield renderer


@pytest.mark.parametrize("modality", MODALITIES)
def test_shapes_types_and_own_memory(renderer, data, modality):
    first = renderer.render(data, "front", modality)
    assert first.shape == SHAPES[modality]
    assert first.dtype == TYPES[modality]
    kept = first.copy()
    second = renderer.render(data, "back", modality)
    assert not np.shares_memory(first, second)
    assert np.array_equal(first, kept)
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("modality", MODALITIES)
def test_same_state_same_image_another_state_other_pixels(renderer, model, data, modality):
    first = renderer.render(data, "front", modality)
    assert np.array_equal(first, renderer.render(data, "front", modality))
    data.qpos[0] += 0.005
    mujoco.mj_forward(model, data)
    assert not np.array_equal(first, renderer.render(data, "front", modality))
    data.qpos[0] -= 0.005
    mujoco.mj_forward(model, data)
    assert np.array_equal(first, renderer.render(data, "front", modality))


def test_several_modalities_in_one_call_are_the_same_images(renderer, data):
    together = renderer.render_all(data, "front", MODALITIES)
    for modality in MODALITIES:
        assert np.array_equal(together[modality], renderer.render(data, "front", modality))


def test_depth_of_a_plane_and_of_nothing(renderer, data):
    depth = renderer.render(data, "front", "depth")[..., 0]
    parts = renderer.render(data, "front", "segmentation")[..., 0]
    assert np.abs(depth[parts == PARTS.index("phantom")] - PLANE_DISTANCE).max() < 1e-4
    assert np.allclose(depth[0, 0], 2.0, atol=1e-4)  # the far plane: extent 0.1 m times zfar 20
    assert np.isclose(depth[parts == PARTS.index("needle")].min(), 0.08 - BALL_RADIUS, atol=1e-4)


def test_segmentation_names_every_part(renderer, model, data):
    assert [PARTS[part] for part in parts_of_geoms(model)] == [
        "background",
        "phantom",
        "needle",
        "thread",
        "psm1",
        "psm2",
    ]
    parts = renderer.render(data, "front", "segmentation")
    assert set(np.unique(parts)) == set(range(len(PARTS)))


@pytest.mark.parametrize("camera", ["front", "back"])
def test_camera_matrices_find_the_needle(renderer, model, data, camera):
    rows, columns = np.nonzero(
        renderer.render(data, camera, "segmentation")[..., 0] == PARTS.index("needle")
    )
    T_world_camera = extrinsics(model, data, camera)
    assert np.allclose(T_world_camera[:3, :3] @ T_world_camera[:3, :3].T, np.eye(3), atol=1e-12)
    needle_in_camera = (np.linalg.inv(T_world_camera) @ [*data.body("needle").xpos, 1.0])[:3]
    pixel = intrinsics(model, camera, *SIZE) @ needle_in_camera / needle_in_camera[2]
    assert np.allclose(pixel[:2], [columns.mean(), rows.mean()], atol=0.4)
    depth = renderer.render(data, camera, "depth")[..., 0]
    centre = depth[round(pixel[1]), round(pixel[0])]
    assert np.isclose(centre, needle_in_camera[2] - BALL_RADIUS, atol=3e-4)


def test_high_quality_differs_and_leaves_the_model_alone(model, data):
    before = [str(model.vis.quality), str(model.vis.global_)]
    with FrameRenderer(model, *SIZE) as fast, FrameRenderer(model, *SIZE, quality="high") as high:
        assert not np.array_equal(fast.render(data, "front"), high.render(data, "front"))
    assert before == [str(model.vis.quality), str(model.vis.global_)]


def test_models_and_sizes_side_by_side(model, data):
    """Closing or collecting one renderer leaves the images of the others alone."""
    other = small_spec()
    other.body("phantom").pos[2] -= 0.05
    other_model = other.compile()
    other_data = mujoco.MjData(other_model)
    mujoco.mj_forward(other_model, other_data)
    with FrameRenderer(model, *SIZE) as kept:
        before = kept.render_all(data, "front", MODALITIES)
        for size in ((64, 64), (1200, 1600)):
            with FrameRenderer(other_model, *size) as second:
                assert second.render(other_data, "front").shape == (*size, 3)
                assert np.isclose(second.render(other_data, "front", "depth").max(), 2.0, atol=1e-4)
        twin = FrameRenderer(model, *SIZE)
        del twin
        after = kept.render_all(data, "front", MODALITIES)
    assert all(np.array_equal(before[name], after[name]) for name in MODALITIES)


def test_wrong_arguments_are_refused_with_what_exists(model, data):
    with pytest.raises(UnknownName, match="fast, high"):
        FrameRenderer(model, *SIZE, quality="best")
    with pytest.raises(InputError, match="4096"):
        FrameRenderer(model, 0, 10)
    renderer = FrameRenderer(model, *SIZE)
    with pytest.raises(UnknownName, match="back, front"):
        renderer.render(data, "fornt")
    with pytest.raises(UnknownName, match="depth, rgb, segmentation"):
        renderer.render(data, "front", "normals")
    renderer.close()
    renderer.close()
    with pytest.raises(InputError, match="closed"):
        renderer.render(data, "front")


def _image_in_child(queue, renderer, data):
    with FrameRenderer(renderer.model, *SIZE) as own:
        queue.put((own.render(data, "front"), renderer.render(data, "front")))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
@pytest.mark.filterwarnings(
    "ignore:This process:DeprecationWarning"
)  # threads of numpy, which the child does not use
def test_a_forked_child_draws_the_same_image(model, data):
    """Gymnasium's vector environments fork, and the parent may have drawn before."""
    context = multiprocessing.get_context("fork")
    with FrameRenderer(model, *SIZE) as renderer:
        expected = renderer.render(data, "front")
        queue = context.Queue()
        child = context.Process(target=_image_in_child, args=(queue, renderer, data))
        child.start()
        own, inherited = queue.get(timeout=60)
        child.join(timeout=60)
        assert child.exitcode == 0
        assert np.array_equal(own, expected)
        assert np.array_equal(inherited, expected)
        assert np.array_equal(renderer.render(data, "front"), expected)


def test_renderer_string_names_the_renderer():
    assert len(renderer_string()) > 3


def test_a_process_that_closes_nothing_ends_cleanly():
    code = (
        "import sys; sys.path.insert(0, 'tests/helpers')\n"
        "import mujoco; from small_scene import small_spec\n"
        "from surgicai_vision.scene.rendering import FrameRenderer\n"
        "model = small_spec().compile(); data = mujoco.MjData(model)\n"
        "mujoco.mj_forward(model, data)\n"
        "renderers = [FrameRenderer(model, 32, 32), FrameRenderer(model, 64, 64, 'high')]\n"
        "print(sum(r.render(data, 'front').mean() > 0 for r in renderers))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "2\n", "")


def test_a_renderer_that_outlives_the_names_of_its_module_is_closed(monkeypatch):
    renderer = FrameRenderer(small_spec().compile(), 32, 32)
    monkeypatch.setattr(rendering, "sys", None)  # as towards the end of a process
    renderer.__del__()
    assert renderer._target is None
