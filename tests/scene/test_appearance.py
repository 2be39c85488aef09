"""Appearance: seeded looks that are part of the model, and families that training never sees."""

import copy
import dataclasses
import subprocess
import sys
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.errors import UnknownName
from surgicai_vision.scene import build_scene
from surgicai_vision.scene.rendering import FrameRenderer
from surgicai_vision.scene.visual import appearance, families
from surgicai_vision.scene.visual.appearance import Appearance, draw_look, draw_textures
from surgicai_vision.scene.visual.families import FAMILIES, Finish, Lamps

SIZE = (120, 160)


@pytest.fixture
def source():
    return build_scene(SceneConfig()).model


@pytest.fixture
def model(source):
    return copy.copy(source)


def at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def seen(source, model, look: Appearance, camera: str = "front") -> np.ndarray:
    appearance.apply(source, model, look)
    with FrameRenderer(model, *SIZE) as renderer:
        return renderer.render(at_rest(model), camera)


def parts(value: object) -> Iterator[object]:
    """Yield a family's patterns, finishes and lamps, and the colours of the last two."""
    for field in dataclasses.fields(value):
        part = getattr(value, field.name)
        if isinstance(part, Finish | Lamps):
            yield part
            colours = ("first", "second") if isinstance(part, Finish) else ("warm", "cool")
            yield from (getattr(part, name) for name in colours)
        else:
            yield part


WHITE = (255.0, 255.0, 255.0)
"""A tint that leaves a texture unchanged, hence no colour in its own right."""


SHOWN_IN_TRAINING = (
    *names.TRAIN_APPEARANCES,
    *names.VARIED_APPEARANCES,
    *names.RANDOM_APPEARANCES,
)


def test_families_are_those_of_the_names_five_to_train_three_held_out():
    assert tuple(FAMILIES) == names.APPEARANCES
    assert len(names.TRAIN_APPEARANCES) == 5
    assert len(names.HELDOUT_APPEARANCES) == 3
    assert not set(SHOWN_IN_TRAINING) & set(names.HELDOUT_APPEARANCES)


def test_a_state_of_an_earlier_version_names_the_same_family():
    """A state holds a family's index, so a family keeps it."""
    assert names.APPEARANCES[:8] == (
        *("silicone", "mucosa", "skin", "muscle", "fat"),
        *("liver", "bowel", "scar"),
    )


def test_a_varied_family_is_one_for_training_with_other_surroundings():
    for name, varied in zip(names.TRAIN_APPEARANCES, names.VARIED_APPEARANCES, strict=True):
        own, other = vars(FAMILIES[name]), vars(FAMILIES[varied])
        assert {part for part in own if own[part] != other[part]} == {
            *("drape", "tray", "tray_finish")
        }


def test_a_random_family_keeps_the_needle_and_thread_of_one_for_training():
    for name, random in zip(names.TRAIN_APPEARANCES, names.RANDOM_APPEARANCES, strict=True):
        own, other = vars(FAMILIES[name]), vars(FAMILIES[random])
        assert {part for part in own if own[part] == other[part]} == {
            *("metal", "needle", "thread")
        }


def test_random_tissues_are_of_any_colour_and_no_two_alike():
    tissues = [draw_textures(Appearance("random_muscle", seed))["tissue"] for seed in range(60)]
    means = np.array([tissue.mean(axis=(0, 1)) for tissue in tissues])
    assert (means.min(axis=0) < 60).all() and (means.max(axis=0) > 180).all()
    assert set(means.argmax(axis=1)) == {0, 1, 2}
    assert len({tissue.tobytes() for tissue in tissues}) == len(tissues)


def test_random_cloths_are_of_any_colour_and_no_two_alike():
    cloths = [draw_textures(Appearance("varied_fat", seed))["drape"] for seed in range(80)]
    means = np.array([cloth.mean(axis=(0, 1)) for cloth in cloths])
    assert (means.min(axis=0) < 60).all() and (means.max(axis=0) > 180).all()
    strongest = means.argmax(axis=1)  # red, green or blue
    assert set(strongest) == {0, 1, 2}
    assert len({cloth.tobytes() for cloth in cloths}) == len(cloths)


def test_held_out_families_share_no_part_with_those_for_training():
    trained, held = (
        [part for name in group for part in parts(FAMILIES[name])]
        for group in (SHOWN_IN_TRAINING, names.HELDOUT_APPEARANCES)
    )
    assert [part for part in held if part in trained and part != WHITE] == []


def test_families_for_training_draw_nothing_of_the_held_out(monkeypatch, source, model):
    """With every held-out part broken, each training family can still be drawn and rendered."""

    def broken(*_: object) -> None:
        raise AssertionError("a held-out part was drawn")

    table = dict(FAMILIES)
    for name in names.HELDOUT_APPEARANCES:
        fields = dataclasses.fields(table[name])
        table[name] = dataclasses.replace(table[name], **{f.name: broken for f in fields})
    monkeypatch.setattr(appearance, "FAMILIES", table)
    draw_textures.cache_clear()
    for name in SHOWN_IN_TRAINING:
        for seed in range(3):
            seen(source, model, Appearance(name, seed))
    for seed in range(100):
        draw_textures(Appearance("varied_skin", seed))
        draw_textures(Appearance("random_skin", seed))
    for name in names.HELDOUT_APPEARANCES:
        with pytest.raises((AssertionError, AttributeError)):
            draw_look(Appearance(name, 0))
        with pytest.raises(AssertionError):
            draw_textures(Appearance(name, 0))


def test_every_family_and_every_seed_looks_different(source, model):
    images = [
        seen(source, model, Appearance(name, seed))
        for name in names.APPEARANCES
        for seed in range(2)
    ] + [seen(source, model, Appearance())]
    for index, image in enumerate(images):
        for other in images[:index]:
            assert np.abs(image.astype(int) - other).mean() > 1.0


def test_an_appearance_is_the_same_in_another_process(source, model):
    code = (
        "import hashlib\n"
        "from surgicai_vision.scene.visual.appearance import *\n"
        "print(draw_look(Appearance('fat', 3)))\n"
        "for image in draw_textures(Appearance('fat', 3)).values():\n"
        "    print(hashlib.sha256(image.tobytes()).hexdigest())\n"
    )
    import contextlib
    import io

    here = io.StringIO()
    with contextlib.redirect_stdout(here):
        exec(code, {})
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert there.stdout == here.getvalue()


def test_textures_have_the_sizes_of_their_slots(source):
    for name in ("", *names.APPEARANCES):
        for texture, image in draw_textures(Appearance(name, 1)).items():
            slot = source.texture(texture)
            assert image.dtype == np.uint8
            assert image.shape == (slot.height[0], slot.width[0], slot.nchannel[0])


def test_textures_tile():
    for name in names.APPEARANCES:
        for texture, image in draw_textures(Appearance(name, 2)).items():
            if texture == "drape":  # grids and stripes jump wherever they are cut
                continue
            steps = np.abs(np.diff(image.astype(int), axis=0)).mean(axis=(1, 2)).max()
            seam = np.abs(image[0].astype(int) - image[-1]).mean()
            assert seam <= 1.5 * steps, (name, texture)


def test_going_back_to_an_appearance_shows_the_same_pixels(source, model):
    """Whatever looks the model has had in between, the plain one included."""
    appearance.apply(source, model, Appearance("muscle", 1))
    with FrameRenderer(model, *SIZE) as renderer, FrameRenderer(source, *SIZE) as compiled:
        first = renderer.render(at_rest(model), "front")
        for look in (Appearance("scar", 2), Appearance()):
            appearance.apply(source, model, look)
            other = renderer.render(at_rest(model), "front")
            assert not np.array_equal(first, other)
        assert np.array_equal(other, compiled.render(at_rest(source), "front"))
        appearance.apply(source, model, Appearance("muscle", 1))
        assert np.array_equal(renderer.render(at_rest(model), "front"), first)


def test_a_mixture_lies_between_its_looks(source, model):
    own, other = Appearance("fat", 1), Appearance("liver", 2)
    images = []
    for share in (0.0, 0.5, 1.0):
        mixture = Appearance("fat", 1, share, "liver", 2)
        images.append(draw_textures(mixture)["tissue"].astype(float))
        seen(source, model, mixture)
    assert np.array_equal(images[0], draw_textures(own)["tissue"])
    assert np.array_equal(images[2], draw_textures(other)["tissue"])
    assert np.abs(images[1] - (images[0] + images[2]) / 2).max() <= 0.5
    for share, look in ((0.0, own), (1.0, other)):
        pixels = seen(source, model, Appearance("fat", 1, share, "liver", 2))
        assert np.abs(pixels.astype(int) - seen(source, model, look)).max() <= 1


def test_numbers_are_an_appearance_and_back():
    last = appearance.SEEDS - 1
    for look in (
        Appearance(),
        Appearance("silicone", 0),
        Appearance("scar", last),
        Appearance("fat", 3, 0.1, "liver", last),
    ):
        assert Appearance.of_numbers(*look.numbers) == look


def test_an_unknown_family_is_refused():
    with pytest.raises(UnknownName, match="mucosa"):
        Appearance("mucos")


@pytest.mark.parametrize("family", names.APPEARANCES)
def test_needle_and_marks_can_be_made_out(source, model, family):
    """Seen from the front, the needle's mean colour differs from that of the tissue around it."""
    for seed in range(3):
        appearance.apply(source, model, Appearance(family, seed))
        data = at_rest(model)
        with FrameRenderer(model, 224, 224) as renderer:
            image = renderer.render(data, "front").astype(float)
            found = renderer.render(data, "front", "segmentation")[..., 0]
        needle = found == names.PARTS.index("needle")
        rows, columns = np.nonzero(needle)
        near = np.zeros_like(needle)
        near[rows.min() - 5 : rows.max() + 6, columns.min() - 5 : columns.max() + 6] = True
        beside = near & (found == names.PARTS.index("phantom"))
        contrast = np.abs(image[needle].mean(axis=0) - image[beside].mean(axis=0)).max()
        assert contrast > 12, (seed, contrast)
        look = draw_look(Appearance(family, seed)).materials
        skin = draw_textures(Appearance(family, seed))["tissue"].reshape(-1, 3).mean(axis=0)
        assert np.abs(np.array(look["ink"].colour) * 255 - skin).max() > 40


def test_the_look_leaves_physics_alone(source, model):
    appearance.apply(source, model, Appearance("bowel", 5))
    states = []
    for each in (source, model):
        data = at_rest(each)
        rng = np.random.default_rng(0)
        for _ in range(10):
            data.ctrl += 0.03 * rng.standard_normal(each.nu)
            mujoco.mj_step(each, data, 30)
        states.append(data.qpos.copy())
    assert np.array_equal(*states)


def test_the_spot_shines_from_the_endoscope(source, model):
    appearance.apply(source, model, Appearance("mucosa", 0))
    appearance.carry_spot(model)
    data = at_rest(model)
    spot = model.light("endoscope").id
    camera = next(n for n in appearance.SPOT_CAMERAS if mujoco.mj_name2id(model, 7, n) >= 0)
    assert model.light_active[spot]
    assert np.allclose(data.light_xpos[spot], data.camera(camera).xpos)
    assert np.allclose(data.light_xdir[spot], -data.camera(camera).xmat.reshape(3, 3)[:, 2])
    assert not source.light_active[spot]


def test_bounds_are_in_order():
    for family in FAMILIES.values():
        for part in parts(family):
            if isinstance(part, Finish | Lamps):
                for field in dataclasses.fields(part):
                    value = getattr(part, field.name)
                    if isinstance(value, tuple) and len(value) == 2:
                        assert 0.0 <= value[0] <= value[1], (part, field.name)
    assert families.FAMILIES is FAMILIES
