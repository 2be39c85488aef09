"""Encoders: one contract for every registered encoder, golden values, and refusals."""

import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from photographs import hopper
from torch import nn

from encoders.base import Encoder, best_dtype, read_torch
from encoders.card import EncoderCard
from encoders.imagenet_lite_early import IMAGENET_LITE_EARLY
from encoders.imagenet_lite_smooth import IMAGENET_LITE_SMOOTH, smoothing
from encoders.packaged import network_from, packaged_file
from surgicai_vision.core.errors import BadFile, InputError, MissingWeights, UnknownName
from surgicai_vision.features import encoders
from surgicai_vision.features.encoders import (
    WeightsSource,
    encoder_card,
    encoder_names,
    load_encoder,
)

OFFLINE = encoders.OFFLINE_ENCODERS


@pytest.fixture(scope="module", params=OFFLINE)
def encoder(request: pytest.FixtureRequest) -> Iterator[Encoder]:
    return load_encoder(request.param)


def images(count: int = 3, size: int = 224) -> np.ndarray:
    """Smooth coloured images, each different."""
    generator = np.random.default_rng(0)
    coarse = torch.from_numpy(generator.uniform(0, 255, (count, 3, 7, 7)).astype(np.float32))
    fine = torch.nn.functional.interpolate(coarse, (size, size), mode="bilinear")
    return fine.permute(0, 2, 3, 1).round().to(torch.uint8).numpy()


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.broadcast_to(np.array(colour, np.uint8), (1, 224, 224, 3))


def test_feature_is_as_declared(encoder: Encoder) -> None:
    features = encoder(images())
    assert features.shape == (3, encoder.card.dim) and features.dtype == np.float32
    assert encoder.dim == encoder.card.dim == encoder.shape[0]
    assert np.isfinite(features).all() and features.std() > 0


def test_same_image_same_feature_in_any_batch(encoder: Encoder) -> None:
    frames = images(20)
    together = encoder(frames)
    assert np.array_equal(together, encoder(frames))
    for at in (0, 7, 19):
        np.testing.assert_array_equal(together[at], encoder(frames[at : at + 1])[0])
    np.testing.assert_array_equal(together, encoder(frames[::-1])[::-1])


class Restless(torch.nn.Module):
    """A network whose answer depends on the batch size."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[int] = []

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.asked.append(len(images))
        return images.mean((2, 3)) + len(images)


def test_left_over_images_are_padded_only_where_the_network_needs_it() -> None:
    card = encoders.encoder_card("random")
    frames = images(11)
    restless = Encoder(card, Restless(), dtype=torch.float32)
    together = restless(frames)
    np.testing.assert_array_equal(
        np.concatenate([restless(frames[i : i + 1]) for i in range(11)]), together
    )
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten())
    calm = Encoder(card, network, dtype=torch.float32)
    np.testing.assert_array_equal(
        np.concatenate([calm(frames[i : i + 1]) for i in range(11)]), calm(frames)
    )
    network.asked = []
    network.register_forward_pre_hook(lambda module, given: module.asked.append(len(given[0])))
    if calm._any_size:
        calm(frames)
        assert sorted(network.asked) == [1, 2, 8], "every image is computed once"


def test_feature_survives_the_cache(encoder: Encoder) -> None:
    features = encoder(images())
    np.testing.assert_array_equal(features, features.astype(np.float16).astype(np.float32))


def test_red_and_blue_differ(encoder: Encoder) -> None:
    red, blue = encoder(plain((255, 0, 0))), encoder(plain((0, 0, 255)))
    assert np.linalg.norm(red - blue) > 0.05 * np.linalg.norm(red)


def test_frozen_for_good(encoder: Encoder) -> None:
    """Nothing that training does changes weights or buffers."""
    before, feature = encoder.state_sha256(), encoder(images())
    network = encoder._network
    assert not any(parameter.requires_grad for parameter in network.parameters())
    network.train()
    for part in network.modules():
        part.train(True)
        assert not part.training
    encoder(images(20))
    assert encoder.state_sha256() == before
    np.testing.assert_array_equal(encoder(images()), feature)


def test_frames_of_other_sizes_are_resized_with_antialias(encoder: Encoder) -> None:
    small, large = images(2, 224), images(2, 448)
    near = encoder(large)
    assert np.linalg.norm(encoder(small) - near) < 0.3 * np.linalg.norm(near)
    stripes = np.zeros((1, 448, 448, 3), np.uint8)
    stripes[:, :, ::2] = 255  # beyond what 224 px can show: antialiasing gives an even grey
    resized = encoder.preprocess(stripes)[..., 4:-4, 4:-4]
    assert float(resized.std(dim=(2, 3)).max()) < 0.1


def test_normalisation_is_the_cards(encoder: Encoder) -> None:
    card, frames = encoder.card, images(1)
    low, high = card.input_range
    wanted = (low + frames[0].astype(np.float64) / 255 * (high - low) - card.mean) / card.std
    got = encoder.preprocess(frames)[0].permute(1, 2, 0).cpu().numpy()
    np.testing.assert_allclose(got, wanted, atol=1e-4)


@pytest.mark.parametrize(
    "frames",
    [
        np.zeros((2, 3, 224, 224), np.uint8),
        np.zeros((224, 224, 3), np.uint8),
        np.zeros((1, 224, 224, 3), np.float32),
    ],
)
def test_other_frames_are_refused(encoder: Encoder, frames: np.ndarray) -> None:
    with pytest.raises(InputError, match="uint8 RGB"):
        encoder(frames)


def test_no_frames_give_no_rows(encoder: Encoder) -> None:
    assert encoder(np.zeros((0, 224, 224, 3), np.uint8)).shape == (0, encoder.dim)


@pytest.mark.parametrize("name", encoder_names())
def test_card_is_complete(name: str) -> None:
    card: EncoderCard = encoder_card(name)
    assert (
        card.name == name
        and card.architecture
        and card.source
        and card.revision
        and card.licence
        and card.paper
    )
    assert "(global)" in card.layers
    assert card.channel_order == "RGB" and card.interpolation in ("bilinear", "bicubic")
    assert all(value > 0 for value in card.std) and card.dim > 0
    assert card.offline == (name in OFFLINE)
    # The middle of the range must come out near zero, which fails if mean and range
    # differ in units.
    middle = (sum(card.input_range) / 2 - np.array(card.mean)) / np.array(card.std)
    assert np.abs(middle).max() < 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"channel_order": "bgr"}, "Unknown channel_order 'bgr'. Allowed: BGR, RGB"),
        ({"interpolation": "cubic"}, "Unknown interpolation 'cubic'. Did you mean 'bicubic'"),
        ({"batch": 0}, "batch is 0; it must be at least 1"),
        ({"input_size": 0}, "input_size is 0; it must be at least 1"),
        ({"mean": (0.5,)}, r"mean is \(0.5,\), std .*each has three values"),
        ({"std": (0.5, 0.5, 0.0)}, "std of B is 0.0; it must be above 0"),
    ],
)
def test_a_card_that_no_image_fits_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        replace(encoder_card("random"), **change)


def test_r3m_takes_0_to_255_and_divides_itself() -> None:
    card = encoder_card("r3m")
    grey = np.full(3, 200.0)
    ours = (grey - card.mean) / card.std
    theirs = (grey / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    assert card.input_range == (0, 255)
    np.testing.assert_allclose(ours, theirs)


RANDOM_SHA256 = "4859e98433459ccf88d9ee47052477c9f921269164116b2b9f5b318f8a582b92"
"""State hash of `random` on x86-64. Regenerate:
python -c "from surgicai_vision.features.encoders import load_encoder as l;
print(l('random').weights_sha256)"."""


def test_random_is_reproducible_and_leaves_the_global_state() -> None:
    before = torch.get_rng_state()
    first = load_encoder("random")
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(99)
    assert load_encoder("random").weights_sha256 == first.weights_sha256
    if platform.machine() == "x86_64":
        assert first.weights_sha256 == RANDOM_SHA256


def test_imagenet_lite_classifies() -> None:
    """The tensors, mapped by position, are the trained network: it classifies a photograph."""
    import timm

    network = timm.create_model("tf_efficientnet_lite0")
    tensors = read_torch(packaged_file())
    network.load_state_dict(dict(zip(network.state_dict(), tensors.values(), strict=True)))
    with torch.inference_mode():
        image = torch.from_numpy(hopper()).permute(0, 3, 1, 2).float()
        logits = network.eval()((image - 127) / 128)
    assert int(logits.argmax()) == 652, "not 'military uniform'"


@pytest.mark.parametrize(("pool", "shape"), [("spatial", (2048, 7, 7)), ("tokens", (49, 2048))])
def test_maps_and_tokens_average_to_the_global_feature(pool: str, shape: tuple[int, ...]) -> None:
    encoder = load_encoder("random", pool=pool)
    assert encoder.shape == shape and encoder.dim == 49 * 2048
    features = encoder(hopper()).reshape(shape)
    mean = features.mean(axis=(1, 2) if pool == "spatial" else 0)
    whole = load_encoder("random")
    np.testing.assert_allclose(mean, whole(hopper())[0], rtol=0.02, atol=0.05)
    assert whole.fingerprint != encoder.fingerprint


class Mapped(nn.Module):
    """Means of patches of 8 pixels, with the channels where `output_fmt` says, as timm does."""

    def __init__(self, output_fmt: str) -> None:
        super().__init__()
        self.pool = nn.AvgPool2d(8)
        self.output_fmt = output_fmt

    def forward_features(self, images: torch.Tensor) -> torch.Tensor | list[torch.Tensor]:
        """Return the map, or two maps."""
        patches = self.pool(images)
        if self.output_fmt == "NHWC":
            return patches.permute(0, 2, 3, 1)
        return patches if self.output_fmt == "NCHW" else [patches, patches]

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return (B, 3) means."""
        return images.mean((2, 3))


@pytest.mark.parametrize(("pool", "shape"), [("spatial", (3, 4, 4)), ("tokens", (16, 3))])
def test_a_map_is_read_with_its_channels_where_the_network_has_them(
    pool: str, shape: tuple[int, ...]
) -> None:
    """Swin of timm gives (B, h, w, C)."""
    card = replace(IMAGENET_LITE_EARLY.card, name="own", architecture="mine", dim=3, input_size=32)
    first, last = (Encoder(card, Mapped(order), pool=pool) for order in ("NCHW", "NHWC"))
    assert first.shape == last.shape == shape
    np.testing.assert_array_equal(first(images(2, 32)), last(images(2, 32)))
    with pytest.raises(InputError, match="several feature maps"):
        Encoder(card, Mapped("two"), pool=pool)


def test_a_gpu_that_only_emulates_bfloat16_computes_in_float32(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def supported(including_emulation: bool = True) -> bool:
        return including_emulation

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", supported)
    assert best_dtype(torch.device("cuda")) == torch.float32


class Shrunk(nn.Module):
    """An encoder without weights."""

    def __init__(self, pool: nn.Module, calls: Callable[[torch.Tensor], torch.Tensor] = torch.relu):
        super().__init__()
        self.pool, self.calls = pool, calls

    def extra_repr(self) -> str:
        """Print a function, whose address differs in every process."""
        return repr(self.calls)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return (B, 3) means."""
        return self.pool(images).mean((2, 3))


class Doubled(Shrunk):
    """The same layers, different code."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return (B, 3) means, doubled."""
        return 2 * self.pool(images).mean((2, 3))


def test_a_network_that_computes_something_else_has_another_fingerprint() -> None:
    """Without weights, nothing else would distinguish it from the one before."""
    card = replace(IMAGENET_LITE_EARLY.card, name="own", architecture="mine", dim=3, input_size=32)
    other = (card, Shrunk(nn.MaxPool2d(8))), (card, Doubled(nn.AvgPool2d(8)))
    renamed = replace(card, revision="2"), Shrunk(nn.AvgPool2d(8))
    one, again = (Encoder(card, Shrunk(nn.AvgPool2d(8), lambda x: x)) for _ in range(2))
    assert one.fingerprint == again.fingerprint
    prints = {Encoder(*made).fingerprint for made in (*other, renamed)}
    assert len(prints | {Encoder(card, Shrunk(nn.AvgPool2d(8))).fingerprint}) == 4


def test_early_features_are_the_whole_networks_on_the_way() -> None:
    whole = network_from(read_torch(packaged_file()), packaged_file()).eval()
    wanted = []
    whole.blocks[2].register_forward_hook(lambda module, given, answer: wanted.append(answer))
    early = Encoder(
        *IMAGENET_LITE_EARLY.build(IMAGENET_LITE_EARLY.card, None),
        pool="spatial",
        device=torch.device("cpu"),  # a GPU rounds the factors in convolutions to 10 bits
        dtype=torch.float32,
    )
    assert early.shape == (40, 28, 28)
    with torch.inference_mode():
        whole((torch.from_numpy(hopper()).permute(0, 3, 1, 2).float() - 127) / 128)
    np.testing.assert_allclose(
        early(hopper()).reshape(1, 40, 28, 28), wanted[0].numpy(), rtol=2e-3, atol=2e-3
    )


def test_smoothing_is_a_gaussian_and_then_the_early_network() -> None:
    image = hopper()[0].astype(np.float32)
    given = torch.from_numpy(image).permute(2, 0, 1)[None]
    with torch.inference_mode():
        smoothed = torch.nn.Sequential(*smoothing())(given)
        smooth = IMAGENET_LITE_SMOOTH.build(IMAGENET_LITE_SMOOTH.card, None)[1].eval()
        early = IMAGENET_LITE_EARLY.build(IMAGENET_LITE_EARLY.card, None)[1].eval()
        torch.testing.assert_close(smooth(given), early(smoothed))
    wanted = cv2.GaussianBlur(image, (11, 11), 1.5)
    np.testing.assert_allclose(smoothed[0].permute(1, 2, 0).numpy(), wanted, atol=1e-2)


def test_smooth_features_keep_more_of_a_noisy_image() -> None:
    noise = np.random.default_rng(0).normal(0, 32, hopper().shape)
    noisy = np.clip(np.round(hopper() + noise), 0, 255).astype(np.uint8)
    changed = {}
    for name in ("imagenet-lite-early", "imagenet-lite-smooth"):
        encoder = load_encoder(name, "spatial")
        clean = encoder(hopper())
        changed[name] = np.abs(encoder(noisy) - clean).mean() / clean.std()
    assert changed["imagenet-lite-smooth"] < 0.8 * changed["imagenet-lite-early"]


def test_unknown_encoder_suggests() -> None:
    with pytest.raises(UnknownName, match="Did you mean 'imagenet-lite'"):
        load_encoder("imagnet-lite")
    with pytest.raises(UnknownName, match="global"):
        load_encoder("random", pool="globl")


def test_missing_weights_are_named_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    started = time.monotonic()
    with pytest.raises(MissingWeights) as caught:
        load_encoder("r3m")
    assert (
        time.monotonic() - started < 30
    )  # not a speed test: the hub client alone would retry for longer
    line = str(caught.value)
    for part in (
        "pytorch_model.bin",
        "surajnair/r3m-50",
        encoder_card("r3m").sha256,
        "--weights FILE",
        *OFFLINE,
    ):
        assert part in line
    assert "\n" not in line and "http" not in line


def test_weights_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match="not a file"):
        load_encoder("r3m", weights=WeightsSource.of(tmp_path / "none.bin"))
    (tmp_path / "some.bin").write_bytes(b"x")
    with pytest.raises(InputError, match="leave --weights out"):
        load_encoder("random", weights=WeightsSource.of(tmp_path / "some.bin"))


GOLDEN = (0.15637, 0.0, 0.07037, 0.09735, 0.0)
"""First features of `imagenet-lite` on the photograph, in float32. Regenerate (from tests/): print
`Encoder(*IMAGENET_LITE.build(IMAGENET_LITE.card, None), dtype=torch.float32)(hopper())[0, :5]`."""


def test_golden_features_in_float32_and_near_them_in_bfloat16() -> None:
    from encoders.imagenet_lite import IMAGENET_LITE

    exact, rounded = (
        Encoder(*IMAGENET_LITE.build(IMAGENET_LITE.card, None), dtype=dtype)(hopper())[0]
        for dtype in (torch.float32, torch.bfloat16)
    )
    np.testing.assert_allclose(exact[:5], GOLDEN, atol=2e-3)
    assert np.linalg.norm(exact - rounded) < 0.08 * np.linalg.norm(exact)  # 4 % measured
