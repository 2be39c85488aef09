"""Detection: labels lie on the jaws, the network finds them, a kill costs at most an epoch."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.corruption import CORRUPTIONS, Moment
from surgicai_vision.core.errors import BadFile, InputError, OutputExists
from surgicai_vision.demos.record import record
from surgicai_vision.detection import fit
from surgicai_vision.detection.card import CARD, WEIGHTS
from surgicai_vision.detection.detector import load_detector, tensor_of
from surgicai_vision.detection.examples import SIZE, WHOLE, render_examples
from surgicai_vision.detection.network import (
    CELLS,
    JawNetwork,
    _centres,
    _in_cells,
    loss,
    read_places,
)
from surgicai_vision.envs.projection import jaws_in_image

AWAY = RandomisationConfig(camera_shift=10.0, camera_turn=10.0, camera_fovy=10.0)
NEAR = 8
"""Pixels within which closed jaws are of their grasp point."""


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """Three placements by the expert."""
    out = tmp_path_factory.mktemp("detection") / "demos"
    record(TaskConfig("place"), episodes=3, out=out)
    return out


@pytest.fixture
def in_process(monkeypatch):
    """Train small, without other processes."""
    from surgicai_vision.core.executor import RunContext

    def train(demos, out, **changes):
        asked = {"per_demo": 2, "epochs": 2, **changes}
        return fit.train_detector([demos], out, context=RunContext(workers=0), **asked)

    return train


@pytest.mark.parametrize("camera", ["front", "back"])
@pytest.mark.parametrize("arm", names.ARMS)
def test_a_label_is_the_centre_of_the_crop_where_nothing_is_off(camera, arm):
    env = envs.make(TaskConfig("place"))
    env.reset(seed=names.VALIDATION_SEED)
    window = env.calibration.window(f"{camera}_{arm}", (224, 224))
    x, y = jaws_in_image(env.simulation, camera, arm, WHOLE)
    middle = (x * window.width - 112, y * window.height - 112)
    limits = ((0, window.width - 224), (0, window.height - 224))
    clamped = [min(max(at, low), high) for at, (low, high) in zip(middle, limits, strict=True)]
    np.testing.assert_allclose(clamped, (window.left, window.top), atol=0.51)


@pytest.mark.parametrize("seed", range(names.VALIDATION_SEED, names.VALIDATION_SEED + 4))
def test_a_label_follows_a_camera_that_is_off(seed):
    """The image shows the jaws that hold the needle, though the nominal calibration is wrong."""
    env = envs.make(TaskConfig("place", randomisation=AWAY))
    env.reset(seed=seed)
    shown = 0
    for camera in ("front", "back"):
        parts = env.image(camera, WHOLE, names.SEGMENTATION)[..., 0]
        x, y = jaws_in_image(env.simulation, camera, "psm2", WHOLE)
        if 0 <= x <= 1 and 0 <= y <= 1:
            column, row = int(x * WHOLE[1]), int(y * WHOLE[0])
            about = parts[max(row - NEAR, 0) : row + NEAR, max(column - NEAR, 0) : column + NEAR]
            assert (about == names.PARTS.index("psm2")).any(), camera
            shown += 1
    assert shown


def test_examples_are_of_other_cameras_and_the_same_for_any_number_of_workers(demos, tmp_path):
    from surgicai_vision.core.executor import RunContext
    from surgicai_vision.demos.store import list_demos

    one, other = (
        render_examples(
            list_demos(demos), tmp_path / str(workers), ("front", "back"), 2, RunContext(workers)
        )
        for workers in (0, 2)
    )
    assert one.images.shape == (12, *SIZE, 3) and one.places.shape == (12, 2, 2)
    assert one.cameras.tolist() == [0, 1] * 6
    assert one.demos.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    for array in ("images", "places", "cameras", "demos"):
        np.testing.assert_array_equal(getattr(one, array), getattr(other, array))
    assert len(np.unique(one.places, axis=0)) == 12


def test_the_target_itself_has_the_least_loss_and_is_read_exactly():
    torch.manual_seed(0)
    places = torch.rand(8, 2, 2) * 0.8 + 0.1
    away = _in_cells(places)[:, :, None] - _centres(places.device)
    target = (-away.square().sum(dim=3) / 2).log_softmax(dim=2)
    found, sure = read_places(target)
    off = (_in_cells(found) - _in_cells(places)).abs()
    assert off.max() < 0.1 and sure.min() > 0.9
    best = loss(target, places)
    for step in (0.01, -0.01):
        assert loss(target, places + step) > best


def test_places_outside_the_image_do_not_count():
    answers = torch.zeros(1, 2, CELLS[0] * CELLS[1]).log_softmax(dim=2)
    inside = torch.tensor([[[0.5, 0.5], [0.5, 0.5]]])
    half = torch.tensor([[[0.5, 0.5], [1.5, 0.5]]])
    nowhere = torch.full((1, 2, 2), -0.5)
    assert loss(answers, half) == pytest.approx(float(loss(answers, inside)))
    assert loss(answers, nowhere) == 0


def test_the_network_learns_to_find_two_dots_and_tells_cameras_apart():
    """The first dot is red and the second green in one camera, the other way round in the other."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)

    def drawn(count):
        images = np.full((count, *SIZE, 3), 60, np.uint8)
        places = rng.uniform(0.1, 0.9, (count, 2, 2))
        cameras = rng.integers(0, 2, count)
        for image, pair, camera in zip(images, places, cameras, strict=True):
            for dot, (x, y) in enumerate(pair):
                column, row = round(x * SIZE[1]), round(y * SIZE[0])
                image[row - 2 : row + 2, column - 2 : column + 2, dot ^ int(camera)] = 250
        return tensor_of(images), torch.from_numpy(cameras), torch.tensor(places).float()

    network = JawNetwork(2)
    optimiser = torch.optim.Adam(network.parameters(), 0.003)
    for _ in range(70):
        images, cameras, places = drawn(16)
        optimiser.zero_grad()
        loss(network(images, cameras), places).backward()
        optimiser.step()
    images, cameras, places = drawn(32)
    network.eval()
    with torch.no_grad():
        found, _ = read_places(network(images, cameras))
    off = (_in_cells(found) - _in_cells(places)).norm(dim=2)
    assert off.median() < 1


def test_a_killed_training_ends_in_the_same_detector(demos, tmp_path, in_process, monkeypatch):
    whole = in_process(demos, tmp_path / "whole")
    write = fit.write_state

    def killed(store, state):
        write(store, state)
        raise KeyboardInterrupt

    monkeypatch.setattr(fit, "write_state", killed)
    with pytest.raises(KeyboardInterrupt):
        in_process(demos, tmp_path / "killed")
    assert not (tmp_path / "killed").exists()
    monkeypatch.setattr(fit, "write_state", write)
    rendered = fit.render_examples

    def counted(*arguments, **named):
        before = len(list(arguments[1].glob("*")))
        examples = rendered(*arguments, **named)
        assert len(list(arguments[1].glob("*"))) == before  # nothing is rendered again
        return examples

    monkeypatch.setattr(fit, "render_examples", counted)
    assert in_process(demos, tmp_path / "killed") == whole
    one, other = (load_file(tmp_path / name / WEIGHTS) for name in ("whole", "killed"))
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


def test_a_detector_is_kept_and_found_again(demos, tmp_path, in_process, monkeypatch):
    out = tmp_path / "detector"
    card = in_process(demos, out)
    assert set(card.errors) == {"front", "back"} and card.images < 12
    monkeypatch.setattr(fit, "render_examples", None)  # nothing is rendered for a finished one
    assert in_process(demos, out) == card
    with pytest.raises(OutputExists, match="another detector"):
        in_process(demos, out, epochs=3)
    with pytest.raises(OutputExists, match="another detector"):
        in_process(demos, out, per_demo=3)
    images = np.random.default_rng(0).integers(0, 256, (3, *SIZE, 3)).astype(np.uint8)
    places, sure = load_detector(out).find(images, "back")
    assert places.shape == (3, 2, 2) and (sure > 0).all() and (sure <= 1).all()
    alone = np.concatenate([load_detector(out).find(image[None], "back")[0] for image in images])
    np.testing.assert_allclose(places, alone, atol=1e-5)


@pytest.mark.parametrize("name", [CARD, WEIGHTS])
def test_a_damaged_detector_is_refused(demos, tmp_path, in_process, name):
    out = tmp_path / "detector"
    in_process(demos, out)
    path = out / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises((BadFile, InputError)):
        load_detector(out)


def test_the_blur_of_a_part_is_that_of_an_image_of_the_part():
    image = np.random.default_rng(0).integers(0, 256, (96, 96, 3)).astype(np.uint8)
    part = CORRUPTIONS["blur"](image, 1.0, Moment(0, 0, 0, 0.5))
    half = CORRUPTIONS["blur"](image, 0.5, Moment(0, 0, 0))
    np.testing.assert_array_equal(part, half)


def test_the_command_trains_and_says_how_far_off_it_is(demos, tmp_path, capsys):
    out = tmp_path / "detector"
    words = ["--demos", str(demos), "--per-demo", "2", "--epochs", "1", "--workers", "1"]
    assert main(["train-detector", *words, "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["cameras"] == ["front", "back"] and set(said["errors"]) == {"front", "back"}
    assert load_detector(out).card.images == said["images"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--camera", "front_psm2"], "front_psm2 is a crop"),
        (["--camera", "frnt"], "front"),
        (["--camera", "front,front"], "given twice"),
        (["--camera", "endo_left"], "allowed: front, back"),
        (["--camera", "wrist_psm2"], "allowed: front, back"),
        (["--demos", "nowhere"], "nowhere"),
        (["--epochs", "0"], "epochs"),
        (["--demos", "DEMOS,DEMOS"], "given twice"),
    ],
)
def test_wrong_input_is_refused_in_one_line(demos, tmp_path, capsys, words, message):
    words = [word.replace("DEMOS", str(demos)) for word in words]
    given = words if "--demos" in words else ["--demos", str(demos), *words]
    assert main(["train-detector", *given, "--out", str(tmp_path / "detector")]) == 2
    said = capsys.readouterr().err.strip()
    assert message in said and "\n" not in said
    assert not (tmp_path / "detector").exists()
