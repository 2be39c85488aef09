"""Crops: pixels of the whole image, at the place given by reported joints and calibration."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import cameras, names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.envs import poses
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.scene.cameras import (
    CameraPose,
    Crop,
    Window,
    crop_of,
    extrinsics,
    intrinsics,
    stand,
)
from surgicai_vision.scene.crops import whole_size, window_about
from surgicai_vision.scene.rendering import FrameRenderer

SIZE = (112, 112)


def made(task: str = "place", **axes: float) -> SuturingEnv:
    env = envs.make(TaskConfig(task, randomisation=RandomisationConfig(**axes)))
    env.reset(seed=1)
    return env


def window(env: SuturingEnv, view: str, size: tuple[int, int] = SIZE) -> tuple[int, int, int, int]:
    found = env.calibration.window(view, size)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def plain() -> SuturingEnv:
    return made()


@pytest.fixture
def side_psm2() -> Iterator[str]:
    """A camera of another distribution and a crop of it."""
    pose = CameraPose((0.12, 0.03, 0.10), (-0.9, 0.0, -0.5), (0.0, 0.0, 1.0), 0.9)
    cameras.register_camera("side", pose)
    cameras.register_camera("side_psm2", Crop("side", names.PSM2, distance=0.14, span=0.05))
    yield "side_psm2"
    cameras.CAMERAS.unregister("side_psm2")
    cameras.CAMERAS.unregister("side")


@pytest.mark.parametrize("view", names.CROPS)
def test_a_crop_is_cut_from_the_whole_image(plain: SuturingEnv, view: str) -> None:
    """Equal up to the rounding of a rasteriser, which counts pixels from the window's corner.

    A silhouette that passes exactly through a pixel's centre, and a colour at .5 of 255, may round
    either way. In the corner where the counts agree, every bit is the same.
    """
    left, top, height, width = window(plain, view)
    crop = {name: plain.image(view, SIZE, name) for name in names.MODALITIES}
    with FrameRenderer(plain.model, height, width) as renderer:
        whole = renderer.render_all(plain.data, stand(view), names.MODALITIES)
    cut = {name: image[top : top + SIZE[0], left : left + SIZE[1]] for name, image in whole.items()}
    apart = np.abs(crop[names.RGB].astype(int) - cut[names.RGB]).max(axis=2)
    assert (apart > 1).mean() < 5e-4
    assert (apart > 0).mean() < 0.03
    assert (crop[names.SEGMENTATION] != cut[names.SEGMENTATION]).mean() < 5e-4
    np.testing.assert_allclose(crop[names.DEPTH], cut[names.DEPTH], atol=2e-6)


@pytest.mark.parametrize("quality", ["fast", "high"])
def test_where_the_rasteriser_counts_alike_every_bit_is_the_same(
    plain: SuturingEnv, quality: str
) -> None:
    height, width = 214, 285
    corner = Window(0, height - SIZE[0], height, width)  # OpenGL counts from the lower left
    with FrameRenderer(plain.model, height, width, quality) as renderer:
        whole = renderer.render_all(plain.data, "front", names.MODALITIES)
    with FrameRenderer(plain.model, *SIZE, quality) as renderer:
        part = renderer.render_all(plain.data, "front", names.MODALITIES, corner)
    for name in names.MODALITIES:
        np.testing.assert_array_equal(part[name], whole[name][-SIZE[0] :, : SIZE[1]])


@pytest.mark.parametrize("view", names.CROPS)
def test_its_matrices_project_to_the_jaws(plain: SuturingEnv, view: str) -> None:
    crop = crop_of(view)
    assert crop is not None
    K = plain.calibration.intrinsics(view, SIZE)
    T_world_camera = plain.calibration.extrinsics(view)
    np.testing.assert_allclose(
        T_world_camera, extrinsics(plain.model, plain.data, crop.camera), atol=1e-12
    )
    grasp = np.array([*poses.position(plain.simulation.grasp(crop.arm)), 1.0])
    grasp_in_camera = (np.linalg.inv(T_world_camera) @ grasp)[:3]
    u, v = (K @ grasp_in_camera / grasp_in_camera[2])[:2]
    left, top, height, width = window(plain, view)
    inside = 0 < left < width - SIZE[1] and 0 < top < height - SIZE[0]
    if inside:
        assert max(abs(u - 55.5), abs(v - 55.5)) <= 0.5 + 1e-9, "rounded to whole pixels"
    whole = intrinsics(plain.model, crop.camera, height, width)
    np.testing.assert_allclose(K[:2, 2], whole[:2, 2] - [left, top])
    assert math.isclose(SIZE[0] * crop.distance / K[0, 0], crop.span, rel_tol=1 / height)
    assert -T_world_camera[2, 1] > 0.4  # the world's up is up in the image


def test_it_follows_what_the_joints_report_not_where_the_jaws_are() -> None:
    env = made(kinematic_error=0.5)
    view = "front_psm2"
    true = poses.position(env.simulation.grasp(names.PSM2))
    reported = poses.position(env.calibration.reported_grasp(names.PSM2))
    assert 0.001 < math.dist(true, reported) < 0.05
    K = env.calibration.intrinsics(view, SIZE)
    to_camera = np.linalg.inv(env.calibration.extrinsics(view))
    pixels = []
    for point in (true, reported):
        in_camera = (to_camera @ [*point, 1.0])[:3]
        pixels.append((K @ in_camera / in_camera[2])[:2])
    assert np.abs(pixels[1] - 55.5).max() <= 0.5 + 1e-9
    assert np.abs(pixels[0] - 55.5).max() > 3.0


def test_it_does_not_follow_a_camera_that_was_moved(plain: SuturingEnv) -> None:
    """The window stays; the image is what the moved camera sees there."""
    moved = made(camera_shift=5.0, camera_turn=3.0, camera_fovy=3.0)
    moved.set_state(plain.data.qpos, plain.data.qvel)
    for view in names.CROPS:
        assert window(moved, view) == window(plain, view)
        for known in (moved.calibration.intrinsics, plain.calibration.intrinsics):
            np.testing.assert_array_equal(
                known(view, SIZE), plain.calibration.intrinsics(view, SIZE)
            )
        np.testing.assert_array_equal(
            moved.calibration.extrinsics(view), plain.calibration.extrinsics(view)
        )
        assert not np.array_equal(moved.image(view, SIZE), plain.image(view, SIZE))
    left, top, height, width = window(moved, "front_psm2")
    with FrameRenderer(moved.model, height, width) as renderer:
        whole = renderer.render(moved.data, "front", names.SEGMENTATION)
    crop = moved.image("front_psm2", SIZE, names.SEGMENTATION)
    assert (crop != whole[top : top + SIZE[0], left : left + SIZE[1]]).mean() < 5e-4


def test_a_wrist_camera_is_nominally_where_the_joints_say() -> None:
    exact, wrong = made(), made(kinematic_error=0.5)
    for env, same in ((exact, True), (wrong, False)):
        true = extrinsics(env.model, env.data, "wrist_psm2")
        assert np.allclose(env.calibration.extrinsics("wrist_psm2"), true, atol=1e-9) is same


def test_a_window_stays_within_its_image() -> None:
    crop = Crop("front", names.PSM2, distance=0.1, span=0.05)
    height, width = whole_size(crop, 0.9, *SIZE)
    for point in ((9.0, 9.0, 0.1), (-9.0, -9.0, 0.1), (0.01, 0.01, -1.0), (0.0, 0.0, 0.1)):
        found = window_about(crop, point, 0.9, *SIZE)
        assert 0 <= found.left <= width - SIZE[1]
        assert 0 <= found.top <= height - SIZE[0]
        assert (found.height, found.width) == (height, width)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"arm": "psm9"}, "psm9"),
        ({"distance": 0.0}, "distance of the crop of front is 0.0"),
        ({"span": math.nan}, "span"),
        ({"aspect": math.inf}, "aspect"),
        ({"span": "0.05"}, "span"),
    ],
)
def test_a_crop_that_no_camera_can_show_is_refused(changes: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        Crop(**{"camera": "front", "arm": names.PSM2, "distance": 0.1, "span": 0.05, **changes})


def test_a_crop_larger_than_its_image_is_refused() -> None:
    with pytest.raises(InputError, match="spans 200 mm does not fit"):
        whole_size(Crop("front", names.PSM2, distance=0.1, span=0.2), 0.9, *SIZE)
    with pytest.raises(InputError, match="at most 16384"):
        whole_size(Crop("front", names.PSM2, distance=0.1, span=0.0005), 0.9, *SIZE)
    with pytest.raises(InputError, match="narrower image"):
        envs.make(TaskConfig(), "pixels", ("front_psm2",), image_size=(100, 400))


def test_a_crop_without_its_place_is_refused(plain: SuturingEnv) -> None:
    with FrameRenderer(plain.model, *SIZE) as renderer:
        with pytest.raises(InputError, match="'front_psm2' is a crop"):
            renderer.render(plain.data, "front_psm2")
        with pytest.raises(InputError, match="is not within"):
            renderer.render(plain.data, "front", window=Window(200, 0, 200, 300))
    with pytest.raises(InputError, match="give its window"):
        intrinsics(plain.model, "front_psm2", *SIZE)


def test_another_distribution_may_offer_a_crop(side_psm2: str) -> None:
    """It is observed, restored and randomised like ours."""
    axes = RandomisationConfig(camera_shift=3.0, kinematic_error=0.2)
    config = TaskConfig("place", randomisation=axes)
    arguments = {"cameras": (side_psm2, "side"), "image_size": 64, "depth": True}
    one, other = (envs.make(config, "pixels", **arguments) for _ in range(2))
    first, _ = one.reset(seed=3)
    other.reset(seed=4)
    other.set_state_vector(one.get_state())
    second = other.observe()
    assert set(first) == {"side_psm2", "side_psm2_depth", "side", "side_depth"}
    for key in first:
        np.testing.assert_array_equal(first[key], second[key])
    assert not np.array_equal(first["side"], first["side_psm2"])
    parts = one.image(side_psm2, (64, 64), names.SEGMENTATION)
    assert names.PARTS.index("psm2") in parts


@pytest.mark.parametrize("view", names.CAMERAS)
def test_every_view_has_images_and_matrices(plain: SuturingEnv, view: str) -> None:
    """One contract over all cameras and crops."""
    shapes = {names.RGB: 3, names.DEPTH: 1, names.SEGMENTATION: 1}
    for modality, channels in shapes.items():
        image = plain.image(view, SIZE, modality)
        assert image.shape == (*SIZE, channels)
        np.testing.assert_array_equal(image, plain.image(view, SIZE, modality))
    depth = plain.image(view, SIZE, names.DEPTH)
    parts = plain.image(view, SIZE, names.SEGMENTATION)[..., 0]
    K, T_world_camera = (
        plain.calibration.intrinsics(view, SIZE),
        plain.calibration.extrinsics(view),
    )
    # Where the image shows the phantom, depth and matrices give a point on it.
    rows, columns = np.nonzero(parts == names.PARTS.index("phantom"))
    rays = np.linalg.inv(K) @ np.stack([columns, rows, np.ones_like(rows)])
    points = T_world_camera[:3, :3] @ (rays * depth[rows, columns, 0]) + T_world_camera[:3, 3:]
    assert len(rows) > 100
    low, high = np.quantile(points, (0.01, 0.99), axis=1)
    assert (low > [-0.045, -0.08, 0.03]).all()
    assert (high < [0.045, 0.11, 0.085]).all()
