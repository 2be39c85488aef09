"""What is read of a LeRobot checkpoint without loading it, and how odd files are refused."""

import json

import pytest

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import BadFile, UnknownName
from surgicai_vision.evaluation import lerobot_agent

ENV = {
    "type": "surgicai",
    **to_mapping(TaskConfig("grasp")),
    "cameras": ["back"],
    "image_size": 64,
    "encoder": "imagenet-lite",
    "encoder_sha256": "ab",
}
META = {
    "task_config": to_mapping(TaskConfig("grasp")),
    "features": {"encoder": "imagenet-lite", "views": ["back"], "weights_sha256": "ab"},
    "image_size": 64,
}


def write(folder, training, meta=META):
    """Write a checkpoint that sees features, and the dataset it may name."""
    state = {"type": "ENV", "shape": [64]}
    config = {"type": "act", "input_features": {names.ENVIRONMENT_STATE: state}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "model.safetensors").write_bytes(b"weights")
    (folder / "train_config.json").write_text(json.dumps(training))
    marker = folder / "dataset" / names.META_FILE
    marker.parent.mkdir(parents=True)
    marker.write_text(json.dumps(meta))
    return folder


@pytest.mark.parametrize("source", ["env", "dataset"])
def test_features_are_those_of_the_env_or_of_the_dataset(tmp_path, source):
    dataset = {"root": str(tmp_path / "dataset")}
    training = {"env": ENV} if source == "env" else {"dataset": dataset}
    read = lerobot_agent.read(write(tmp_path, training))
    assert read.inputs == lerobot_agent.Inputs(("back",), 64, "imagenet-lite", "ab")


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"cameras": 1}, "cameras is 1; it must be a list"),
        ({"cameras": [7]}, "a camera is 7; it must be text"),
        ({"image_size": 1.5}, "image_size is 1.5; it must be a whole number"),
        ({"encoder": [1]}, r"encoder is \[1\]; it must be text"),
        ({"encoder_sha256": 0.5}, "the hash of the encoder's weights is 0.5; it must be text"),
    ],
)
def test_an_env_of_other_types_is_refused(tmp_path, changes, problem):
    with pytest.raises(BadFile, match=problem):
        lerobot_agent.read(write(tmp_path, {"env": {**ENV, **changes}}))


def test_a_camera_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(UnknownName, match="moon"):
        lerobot_agent.read(write(tmp_path, {"env": {**ENV, "cameras": ["moon"]}}))


def test_a_dataset_whose_place_is_no_text_is_refused(tmp_path):
    with pytest.raises(BadFile, match="root is 7; it must be text"):
        lerobot_agent.read(write(tmp_path, {"dataset": {"root": 7}}))


def test_a_dataset_whose_features_are_of_other_types_is_refused(tmp_path):
    training = {"dataset": {"root": str(tmp_path / "dataset")}}
    meta = {**META, "features": {**META["features"], "views": "back"}}
    with pytest.raises(BadFile, match="cameras is 'back'; it must be a list"):
        lerobot_agent.read(write(tmp_path, training, meta))
