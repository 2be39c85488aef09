"""The identity of a config: fields added later are left out until they are used."""

import dataclasses

import pytest

from surgicai_vision.core.config import (
    SceneConfig,
    TaskConfig,
    digest,
    from_mapping,
    to_identity,
    to_mapping,
)
from surgicai_vision.core.variants import Variants
from surgicai_vision.training.run_config import RunConfig

INK = TaskConfig(scene=SceneConfig(ink="due"))


@pytest.mark.parametrize(
    ("config", "changed"),
    [
        (SceneConfig(), SceneConfig(ink="due")),
        (TaskConfig(), INK),
        (RunConfig(), RunConfig(env=INK)),
        (RunConfig(), RunConfig(variants=Variants("train", 0, 2))),
    ],
)
def test_a_field_of_later_is_left_out_until_it_is_used(config, changed):
    assert to_identity(config).keys() <= to_mapping(config).keys()
    assert to_identity(config) != to_mapping(config)
    assert digest(to_identity(config)) != digest(to_identity(changed))
    assert from_mapping(type(config), to_identity(config), "a test") == config
    assert from_mapping(type(config), to_identity(changed), "a test") == changed


def test_a_field_of_the_beginning_is_always_there():
    scene = SceneConfig()
    names = {field.name for field in dataclasses.fields(scene)}
    assert names - to_identity(scene).keys() == {"ink"}
