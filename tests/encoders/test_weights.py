"""Weights: where they are found, which files are refused, and every loader on a whole file."""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import timm
import torch
from photographs import hopper, photograph
from safetensors.torch import load_file, save_file

from encoders import imagenet, weights
from encoders.base import Encoder, read_torch
from encoders.packaged import packaged_file
from surgicai_vision.core.errors import BadFile, InputError, MissingWeights, UnknownName
from surgicai_vision.core.files import sha256_file
from surgicai_vision.features.encoders import (
    WeightsSource,
    encoder_card,
    encoder_plugin,
    find_weights,
    load_encoder,
)


def table_of(network: torch.nn.Module, prefix: str = "") -> dict[str, torch.Tensor]:
    """The network's state in half precision, small on disk."""
    return {
        prefix + name: value.half() if value.is_floating_point() else value
        for name, value in network.state_dict().items()
    }


def saved(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def r3m_file(path: Path, depth: int = 18) -> Path:
    """A file like R3M's: wrapped, with a data-parallel prefix and the heads we leave out."""
    tensors = table_of(timm.create_model(f"resnet{depth}", num_classes=0), "module.convnet.")
    return saved(
        path,
        {"r3m": {**tensors, "module.lang_rew.pred.0.weight": torch.zeros(2, 2)}, "global_step": 7},
    )


def test_r3m_loader(tmp_path: Path) -> None:
    path = r3m_file(tmp_path / "r3m.bin")
    encoder = load_encoder("r3m-18", weights=WeightsSource.of(path))
    assert encoder(hopper()).shape == (1, 512)
    wanted = torch.load(path, weights_only=True)["r3m"]["module.convnet.conv1.weight"].float()
    got = encoder._network.state_dict()["conv1.weight"].float()
    assert torch.allclose(got, wanted, rtol=1e-2)


@pytest.mark.parametrize("name", ["r3m-18", "imagenet-lite"])
def test_a_card_records_the_hash_of_the_file_that_was_loaded(name: str, tmp_path: Path) -> None:
    own = tmp_path / "file.bin"
    path = r3m_file(own) if name == "r3m-18" else saved(own, read_torch(packaged_file()))
    plugin = encoder_plugin(name)
    card, _ = plugin.build(dataclasses.replace(plugin.card, sha256="published"), path)
    assert card.sha256 == sha256_file(path)


def test_clip_loader_takes_the_image_tower(tmp_path: Path) -> None:
    import open_clip

    network = open_clip.create_model("ViT-B-32", load_weights=False, force_quick_gelu=True).visual
    path = saved(
        tmp_path / "clip.bin", {**table_of(network, "visual."), "logit_scale": torch.zeros(())}
    )
    with pytest.warns(UserWarning, match="not the published"):
        encoder = load_encoder("clip", weights=WeightsSource.of(path))
    assert_stable(encoder, 512)


def test_dinov2_loader_resamples_positions(tmp_path: Path) -> None:
    path = saved(
        tmp_path / "dino.pth",
        table_of(timm.create_model("vit_small_patch14_dinov2", num_classes=0)),
    )
    assert_stable(load_encoder("dinov2", weights=WeightsSource.of(path)), 384)


def test_vc1_loader_leaves_the_decoder_out(tmp_path: Path) -> None:
    tensors = table_of(
        timm.create_model("vit_base_patch16_224", num_classes=0, global_pool="token")
    )
    extra = {"mask_token": torch.zeros(1, 1, 768), "decoder_embed.weight": torch.zeros(2, 2)}
    path = saved(tmp_path / "vc1.bin", {"model": {**tensors, **extra}})
    with pytest.raises(InputError, match="--accept-licence"):
        load_encoder("vc1", weights=WeightsSource.of(path))
    assert_stable(load_encoder("vc1", weights=WeightsSource.of(path, accept_licence=True)), 768)


def test_any_timm_network(tmp_path: Path) -> None:
    save_file(table_of(timm.create_model("resnet18")), tmp_path / "r.safetensors")
    encoder = load_encoder(
        "timm:resnet18.a1_in1k", weights=WeightsSource.of(tmp_path / "r.safetensors")
    )
    assert encoder.card.dim == encoder.dim == 512 and encoder.card.licence
    with pytest.raises(UnknownName, match="resnet1"):
        load_encoder("timm:resnet19")


def test_a_timm_head_with_a_hidden_layer_gives_its_output(tmp_path: Path) -> None:
    save_file(table_of(timm.create_model("mobilenetv3_small_100")), tmp_path / "m.safetensors")
    encoder = load_encoder(
        "timm:mobilenetv3_small_100.lamb_in1k",
        weights=WeightsSource.of(tmp_path / "m.safetensors"),
    )
    assert encoder.card.dim == encoder.dim == 1024
    assert encoder(hopper()).shape == (1, 1024)


def assert_stable(encoder: Encoder, dim: int) -> None:
    """Check the dimension, and that neither batch nor thread count changes a feature."""
    frames = np.concatenate([np.roll(hopper(), 9 * shift, axis=2) for shift in range(11)])
    together = encoder(frames)
    assert together.shape == (11, dim) and encoder.card.dim == dim
    np.testing.assert_array_equal(together[4], encoder(frames[4:5])[0])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        np.testing.assert_array_equal(together, encoder(frames))
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize(
    ("name", "label", "probability"),
    [
        ("cat", 285, 0.73),
        ("coffee", 967, 0.994),
        ("palace", 698, 0.75),
    ],  # Egyptian cat, espresso, palace
)
def test_known_imagenet_file_classifies(
    shared: Path, name: str, label: int, probability: float
) -> None:
    """Stride and statistics match the file: its classifier names the photograph's label."""
    path = known_file(shared)
    encoder, tensors = load_encoder("imagenet", weights=WeightsSource.of(path)), load_file(path)
    logits = (
        torch.from_numpy(encoder(photograph(name))) @ tensors["fc.weight"].T + tensors["fc.bias"]
    )
    probabilities = logits.softmax(1)[0]
    assert int(probabilities.argmax()) == label
    assert float(probabilities.max()) == pytest.approx(probability, abs=0.04), (
        "JPEG and bfloat16 cost up to 0.03"
    )
    card = encoder.card
    assert (
        "conv1" in card.architecture
        and card.mean == (0.48502, 0.45795, 0.40760)
        and "Keras" in card.source
    )


def test_stride_decides_what_the_known_file_sees(shared: Path) -> None:
    """With torchvision's stride the same tensors load but are less sure of the cat."""
    card, network = imagenet.classifier(imagenet.CARD, known_file(shared))
    for stage in (network.layer2, network.layer3, network.layer4):
        stage[0].conv1.stride = (1, 1)
        stage[0].conv2.stride = (2, 2)
    logits = torch.from_numpy(Encoder(card, network, dtype=torch.float32)(photograph("cat")))
    assert float(logits.softmax(1)[0, 285]) < 0.73 - 0.1


def known_file(shared: Path) -> Path:
    path = shared / "weights" / "resnet50_keras_imagenet.safetensors"
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    return path


def test_folder_of_the_environment_finds_the_known_file(
    shared: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(weights.FOLDER_VARIABLE, str(shared / "weights"))
    found = find_weights("imagenet")
    assert found is not None and found.name == "resnet50_keras_imagenet.safetensors"


def test_order_and_hash_of_the_weights_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(weights.FOLDER_VARIABLE, str(tmp_path))
    with pytest.raises(MissingWeights):
        find_weights("r3m-18")
    (tmp_path / "r3m-18.bin").write_bytes(b"any, its hash is not known beforehand")
    assert find_weights("r3m-18") == tmp_path / "r3m-18.bin"
    given = tmp_path / "given.bin"
    given.write_bytes(b"x")
    assert find_weights("r3m-18", weights=WeightsSource.of(given)) == given
    (tmp_path / "r3m").mkdir()
    (tmp_path / "r3m" / "pytorch_model.bin").write_bytes(b"tampered")
    with pytest.raises(BadFile, match=str(encoder_card("r3m").sha256)):
        find_weights("r3m")


def test_every_known_file_may_have_the_encoders_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`imagenet.pth` may hold the first or the second weights of torchvision."""
    monkeypatch.setenv(weights.FOLDER_VARIABLE, str(tmp_path))
    path = tmp_path / "imagenet.pth"
    path.write_bytes(b"weights")
    second = next(known for known in imagenet.VARIANTS if known.filename.endswith("11ad3fa6.pth"))
    monkeypatch.setattr(weights, "sha256_file", lambda _: second.sha256 + 56 * "0")
    assert find_weights("imagenet") == path
    monkeypatch.setattr(weights, "sha256_file", lambda _: 64 * "0")
    with pytest.raises(BadFile, match=f"or {second.sha256} or"):
        find_weights("imagenet")


def test_a_bare_filename_is_taken_only_by_its_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many networks publish their weights as model.safetensors or pytorch_model.bin."""
    monkeypatch.setenv(weights.FOLDER_VARIABLE, str(tmp_path))
    for filename in ("model.safetensors", "pytorch_model.bin"):
        (tmp_path / filename).write_bytes(b"weights of another network")
    for name in ("timm:resnet18.a1_in1k", "imagenet", "r3m-18", "r3m"):
        with pytest.raises(MissingWeights, match=f"as {name}"):
            find_weights(name)
    published = dataclasses.replace(
        encoder_card("dinov2"), sha256=sha256_file(tmp_path / "model.safetensors")
    )
    assert weights.find(published, None, False, ()) == tmp_path / "model.safetensors"


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    whole = r3m_file(tmp_path / "whole.bin")
    (tmp_path / "cut.bin").write_bytes(whole.read_bytes()[:100_000])
    (tmp_path / "text.bin").write_text("<html>not found</html>")
    (tmp_path / "text.safetensors").write_text("<html>not found</html>")
    saved(tmp_path / "list.bin", [torch.zeros(2)])
    for name in ("cut.bin", "text.bin", "text.safetensors", "list.bin"):
        with pytest.raises(BadFile) as caught:
            load_encoder("r3m-18", weights=WeightsSource.of(tmp_path / name))
        assert name in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(BadFile, match=r"lacks|wrong shape"):
        load_encoder("r3m-34", weights=WeightsSource.of(whole))
    with pytest.raises(BadFile, match="does not hold"):
        load_encoder("dinov2", weights=WeightsSource.of(whole))


def test_files_that_would_run_code_are_refused(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path(tmp_path / "harm").touch, ())  # type: ignore[return-value]

    saved(tmp_path / "harm.bin", {"convnet.conv1.weight": Harm()})
    with pytest.raises(BadFile, match="holds only weights"):
        load_encoder("r3m-18", weights=WeightsSource.of(tmp_path / "harm.bin"))
    assert not (tmp_path / "harm").exists()


def test_a_source_that_is_no_repository_of_the_hub_is_not_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(weights, "hub_answers", lambda: False)
    card = dataclasses.replace(encoder_card("r3m"), source="our lab's disk")
    with pytest.raises(MissingWeights, match=r"pytorch_model\.bin .*our lab's disk"):
        weights.find(card, None, True, ())
    assert weights.find(dataclasses.replace(card, offline=True), None, True, ()) is None


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("is_zip", [False, True])
def test_a_torch_file_with_changed_bytes_is_read_or_refused(is_zip: bool, tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    table = torch.nn.Linear(3, 2).state_dict()
    torch.save({"model": table}, path, _use_new_zipfile_serialization=is_zip)
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    for _ in range(300):
        content = bytearray(whole)
        for place in generator.integers(0, len(whole), 3):
            content[place] = generator.integers(0, 256)
        path.write_bytes(content)
        with contextlib.suppress(BadFile):
            read_torch(path)
