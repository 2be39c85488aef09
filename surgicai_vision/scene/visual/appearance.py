"""Appearance: how a scene looks in one episode, given by a family and a seed.

Interface:

* `Appearance(family, seed)` fully identifies a look. The family "" is the plain look that the scene
  was compiled with; the others are `names.APPEARANCES`. With `share`, `other` and `other_seed` it
  is a mixture of two. `Appearance.numbers` are the floats that a state holds for it, and
  `Appearance.of_numbers` is the inverse.
* `draw_look(appearance) -> Look`: colours, finishes and light. Cheap.
* `draw_textures(appearance) -> {texture: image}`: the images on the surfaces, of fixed sizes. Takes
  30 to 80 ms; kept for the last few appearances.
* `apply(source, model, appearance)` writes the look, and the appearance's numbers, into the
  caller's own model. It draws no textures: a `FrameRenderer` reads the numbers before each frame
  (`shown`), and draws and uploads the textures when they differ from those it has (`paint`). So an
  env that renders nothing draws nothing, and every renderer of a model shows its look.

Nothing here touches physics. Everything is drawn from seeded integers by arithmetic that IEEE
fixes: an appearance is the same in every process and on every machine.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.scene.visual import cloths, fields, textures, tissues
from surgicai_vision.scene.visual.families import FAMILIES, Bounds, Finish, Lamps
from surgicai_vision.scene.visual.fields import Image, Size

Vector = tuple[float, float, float]

NUMBERS = "appearance"
"""Name of the model's numeric field that holds the numbers of the appearance it has."""
SEEDS = 1 << 31
"""Seeds are below this, so that a float holds them exactly."""
KEPT = 8
"""How many appearances' textures a process keeps, 1.3 MB each."""
SPOT_DISTANCE = 0.14
"""Distance from the endoscope at which its spot has its stated strength [m]: near the holes."""
SPOT_CAMERAS = ("endo_left", "front")
"""The first of these that a scene has carries the spot."""
WHITE: Image = np.full((1, 1, 3), 255, np.uint8)

SIZES: Mapping[str, Size] = {
    "tissue": tissues.TISSUE_SIZE,
    "drape": cloths.CLOTH_SIZE,
    "tray": cloths.PLATE_SIZE,
    "metal": cloths.PLATE_SIZE,
}
"""Texture → its height and width [pixel], the same in every look."""
TEXTURED = {"tissue": "tissue", "drape": "drape", "tray": "tray", "steel": "metal", "jaw": "metal"}
"""Material → its texture. The plain look has only the first two."""


@dataclass(frozen=True)
class Appearance:
    """A look: a family and a seed within it, or a mixture of two such looks.

    Attributes:
        family: one of `names.APPEARANCES`, or "" for the plain look.
        seed: of what is drawn within the family, 0 to `SEEDS` - 1.
        share: of the other look, 0 to 1.
        other: the other look's family.
        other_seed: its seed.
    """

    family: str = ""
    seed: int = 0
    share: float = 0.0
    other: str = ""
    other_seed: int = 0

    def __post_init__(self) -> None:
        for family in filter(None, (self.family, self.other)):
            check_name("appearance", family, names.APPEARANCES)
        if self.share and not self.other:
            raise InputError(
                f"An appearance has share {self.share} of another one, but names no other; give "
                "other."
            )

    @property
    def numbers(self) -> tuple[float, ...]:
        """Return family, seed, share, other family and its seed; a family by its index, from 1."""
        return (
            *(float(_place(self.family)), float(self.seed)),
            *(self.share, float(_place(self.other)), float(self.other_seed)),
        )

    @classmethod
    def of_numbers(
        cls, family: float, seed: float, share: float, other: float, other_seed: float
    ) -> "Appearance":
        """Return the appearance of `numbers`."""
        families = ("", *names.APPEARANCES)
        return cls(families[int(family)], int(seed), share, families[int(other)], int(other_seed))


def _place(family: str) -> int:
    """Return a family's index in `names.APPEARANCES`, from 1; 0 for the plain look."""
    return names.APPEARANCES.index(family) + 1 if family else 0


@dataclass(frozen=True)
class Material:
    """A material's colour (0 to 1), specular strength and shininess."""

    colour: Vector
    specular: float
    shininess: float


@dataclass(frozen=True)
class Lamp:
    """A lamp's colour times its strength, and the direction in which it shines."""

    diffuse: Vector
    specular: Vector
    direction: Vector
    cutoff: float = 45.0
    exponent: float = 0.0

    @property
    def is_on(self) -> bool:
        """Return True if it gives light."""
        return any(self.diffuse)


@dataclass(frozen=True)
class Look:
    """Everything in an appearance except its textures."""

    materials: Mapping[str, Material]
    ambient: Vector
    head: Lamp
    lamps: Mapping[str, Lamp]


def draw_look(appearance: Appearance) -> Look:
    """Draw the look of a family's appearance.

    Raises:
        UnknownName: the plain appearance, which is the compiled model's own.
    """
    check_name("appearance", appearance.family, names.APPEARANCES)
    family = FAMILIES[appearance.family]
    rng = _generator(appearance, 0)
    finishes = {
        "tissue": family.wet,
        "flesh": family.flesh,
        "inside": family.inside,
        "ink": family.ink,
        "tray": family.tray_finish,
        "needle": family.needle,
        "thread": family.thread,
        "steel": family.steel,
        "jaw": family.jaw,
        "shaft": family.shaft,
    }
    materials = {name: _material(rng, finish) for name, finish in finishes.items()}
    materials["faded_ink"] = materials["ink"]
    ambient, head, lamps = _lamps(rng, family.lamps)
    return Look(materials, ambient, head, lamps)


@functools.lru_cache(maxsize=KEPT)
def draw_textures(appearance: Appearance) -> Mapping[str, Image]:
    """Draw the textures of an appearance, (height, width, 3) uint8 each; do not modify them.

    The plain look has two; the slots of the others are white in it.
    """
    if appearance.share:
        own = draw_textures(Appearance(appearance.family, appearance.seed))
        other = draw_textures(Appearance(appearance.other, appearance.other_seed))
        return {
            name: fields.to_bytes(_mixed(own.get(name, WHITE), image, appearance.share))
            for name, image in other.items()
        }
    if not appearance.family:
        return {"tissue": textures.tissue(), "drape": textures.cloth()}
    family = FAMILIES[appearance.family]
    patterns = {
        "tissue": family.tissue,
        "drape": family.drape,
        "tray": family.tray,
        "metal": family.metal,
    }
    return {
        name: patterns[name](_generator(appearance, 1 + place), size)
        for place, (name, size) in enumerate(SIZES.items())
    }


def _mixed(own: Image, other: Image, share: float) -> fields.Field:
    """Return `own` mixed with a share of `other`."""
    first: fields.Field = np.asarray(own, np.float32)
    second: fields.Field = np.asarray(other, np.float32)
    mixed: fields.Field = first + np.float32(share) * (second - first)
    return mixed


def apply(source: mujoco.MjModel, model: mujoco.MjModel, appearance: Appearance) -> None:
    """Write an appearance into `model`, a copy of the compiled `source`, which is only read."""
    _write(source, model, appearance.family, appearance.seed)
    if appearance.share:
        own = [field.copy() for field in _fields(model)]
        active = model.light_active.copy()
        _write(source, model, appearance.other, appearance.other_seed)
        for before, field in zip(own, _fields(model), strict=True):
            field[:] = before + appearance.share * (field - before)
        model.light_active[:] = np.maximum(active, model.light_active)
    model.numeric(NUMBERS).data[:] = appearance.numbers


def _fields(model: mujoco.MjModel) -> list[NDArray[np.float64]]:
    """Return a model's fields that an appearance sets, except textures and which lights are on."""
    headlight = model.vis.headlight
    return [
        *(model.mat_rgba, model.mat_specular, model.mat_shininess),
        *(model.light_ambient, model.light_diffuse, model.light_specular),
        *(model.light_dir, model.light_cutoff, model.light_exponent),
        *(headlight.ambient, headlight.diffuse, headlight.specular),
    ]


def _write(source: mujoco.MjModel, model: mujoco.MjModel, family: str, seed: int) -> None:
    """Write the look of a family into `model`."""
    for field, compiled in zip(_fields(model), _fields(source), strict=True):
        field[:] = compiled
    model.mat_texid[:] = source.mat_texid
    model.light_active[:] = source.light_active
    if not family:
        return
    look = draw_look(Appearance(family, seed))
    for name, material in look.materials.items():
        index = model.material(name).id
        model.mat_rgba[index, :3] = material.colour
        model.mat_specular[index] = material.specular
        model.mat_shininess[index] = material.shininess
    for name, texture in TEXTURED.items():
        role = mujoco.mjtTextureRole.mjTEXROLE_RGB
        model.mat_texid[model.material(name).id, role] = model.texture(texture).id
    headlight = model.vis.headlight
    headlight.ambient[:] = look.ambient
    headlight.diffuse[:] = look.head.diffuse
    headlight.specular[:] = look.head.specular
    for name, lamp in look.lamps.items():
        index = model.light(name).id
        model.light_active[index] = lamp.is_on
        model.light_diffuse[index] = lamp.diffuse
        model.light_specular[index] = lamp.specular
        model.light_dir[index] = lamp.direction
        model.light_cutoff[index] = lamp.cutoff
        model.light_exponent[index] = lamp.exponent


def carry_spot(model: mujoco.MjModel) -> None:
    """Put the endoscope's spot where its camera is in `model`."""
    known = [model.camera(index).name for index in range(model.ncam)]
    camera = next((name for name in SPOT_CAMERAS if name in known), None)
    if camera is None:
        return
    index = model.light("endoscope").id
    model.light_pos[index] = model.camera(camera).pos
    forward = np.zeros(3)
    mujoco.mju_rotVecQuat(forward, np.array([0.0, 0.0, -1.0]), model.camera(camera).quat)
    model.light_dir[index] = forward


def shown(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Return the numbers of a model's appearance as a view; empty if it has no looks."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, NUMBERS)
    if index < 0:
        return np.zeros(0)
    numbers: NDArray[np.float64] = model.numeric(index).data
    return numbers


def paint(model: mujoco.MjModel, context: mujoco.MjrContext) -> None:
    """Draw the textures of the model's appearance and upload them to an OpenGL context.

    The model keeps those of the plain look, with which a new context begins.
    """
    for name, image in draw_textures(Appearance.of_numbers(*shown(model))).items():
        texture = model.texture(name)
        start = int(model.tex_adr[texture.id])
        place = model.tex_data[start : start + image.size]
        plain = place.copy()
        place[:] = image.ravel()
        mujoco.mjr_uploadTexture(model, context, texture.id)
        place[:] = plain
    context.mat_texid[: model.mat_texid.size] = model.mat_texid.ravel()


def _generator(appearance: Appearance, stream: int) -> np.random.Generator:
    """Return the generator of one part of an appearance."""
    return np.random.default_rng((_place(appearance.family), appearance.seed, stream))


def _between(rng: np.random.Generator, bounds: Bounds) -> float:
    return float(rng.uniform(*bounds))


def _material(rng: np.random.Generator, finish: Finish) -> Material:
    red, green, blue = tissues.mixed(rng, finish.first, finish.second)
    return Material(
        (red / 255.0, green / 255.0, blue / 255.0),
        _between(rng, finish.specular),
        _between(rng, finish.shininess),
    )


def _lamps(rng: np.random.Generator, lamps: Lamps) -> tuple[Vector, Lamp, dict[str, Lamp]]:
    """Draw the ambient light, the light at the cameras and the lamps."""
    red, green, blue = tissues.mixed(rng, lamps.warm, lamps.cool)
    glare = _between(rng, lamps.glare)

    def colour(strength: float) -> Vector:
        return strength * red / 255.0, strength * green / 255.0, strength * blue / 255.0

    def lamp(bounds: Bounds, direction: Vector, *shape: float) -> Lamp:
        strength = _between(rng, bounds)
        return Lamp(colour(strength), colour(glare * strength), direction, *shape)

    ambient = colour(_between(rng, lamps.ambient))
    x, y = rng.uniform(-lamps.lean, lamps.lean, 2).tolist()
    side = 0.7 if rng.uniform() < 0.5 else -0.7
    cutoff = _between(rng, lamps.cutoff)
    exponent = _between(rng, lamps.exponent)
    head = lamp(lamps.head, (0.0, 0.0, -1.0))
    return (
        ambient,
        head,
        {
            "key": lamp(lamps.key, (x, y, -1.0)),
            "fill": lamp(lamps.fill, (side, 0.4, -1.0)),
            "endoscope": lamp(lamps.spot, (0.0, 0.0, -1.0), cutoff, exponent),
        },
    )
