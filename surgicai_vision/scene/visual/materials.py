"""Look: materials, lights, surroundings, and the visible shape of physical parts.

Nothing here touches physics: every geom it adds collides with nothing and weighs nothing (group 1),
and the physical geoms it covers are only moved to a group that is not drawn (group 4). Colours and
lights are chosen so that the needle stands out without shadows, which software rendering cannot
afford; the key light casts one in high quality.
"""

from collections.abc import Mapping

import mujoco
import numpy as np

from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.names import ARMS, PSM1, PSM2
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.kinematics import INSTRUMENTS
from surgicai_vision.scene.phantom import ORIGIN, SIZE, TABLE
from surgicai_vision.scene.visual import (
    appearance,
    distractors,
    shapes,
    skin,
    soft_skin,
    textures,
    tool,
)
from surgicai_vision.scene.visual.shapes import HIDDEN, hide, show

DRAPE_X = (0.04, 0.08, 0.13, 0.19, 0.27, 0.40, 0.60, 0.90)
"""Columns of the drape's points on each side of the phantom's middle [m], closer where the cameras
look. Between the innermost two, below the phantom, it has a hole, because a hidden pixel costs as
much as a visible one."""
DRAPE_WAVE = 0.006
"""Height of its folds [m]."""
SPOT_NEAR = 0.2
"""Constant part of the spot's attenuation; the rest grows with the square of the distance. Without
it the shafts, which pass close to the endoscope, were white."""

Shape = mujoco.mjtGeom.mjGEOM_MESH

MATERIALS: dict[str, Mapping[str, float | list[float]]] = {
    "tissue": {"rgba": [1.0, 1.0, 1.0, 1.0], "specular": 0.35, "shininess": 0.35},
    "flesh": {"rgba": [0.78, 0.45, 0.41, 1.0], "specular": 0.1, "shininess": 0.2},
    "inside": {"rgba": [0.30, 0.07, 0.08, 1.0], "specular": 0.1, "shininess": 0.2},
    "ink": {"rgba": [0.16, 0.10, 0.42, 1.0], "specular": 0.05, "shininess": 0.1},
    "faded_ink": {"rgba": [0.16, 0.10, 0.42, 0.45], "specular": 0.05, "shininess": 0.1},
    "wound": {"rgba": [0.28, 0.02, 0.03, 1.0], "specular": 0.6, "shininess": 0.6},
    "halo": {"rgba": [0.70, 0.10, 0.10, 0.35], "specular": 0.3, "shininess": 0.3},
    "drape": {"rgba": [1.0, 1.0, 1.0, 1.0], "specular": 0.0, "shininess": 0.0},
    "tray": {"rgba": [0.72, 0.74, 0.74, 1.0], "specular": 0.2, "shininess": 0.3},
    "needle": {"rgba": [0.97, 0.98, 1.0, 1.0], "specular": 1.0, "shininess": 0.9},
    "thread": {"rgba": [0.07, 0.05, 0.16, 1.0], "specular": 0.3, "shininess": 0.4},
    "steel": {"rgba": [0.58, 0.60, 0.64, 1.0], "specular": 0.9, "shininess": 0.7},
    "jaw": {"rgba": [0.36, 0.37, 0.40, 1.0], "specular": 0.6, "shininess": 0.5},
    "shaft": {"rgba": [0.13, 0.135, 0.15, 1.0], "specular": 0.7, "shininess": 0.6},
    f"band_{PSM1}": {"rgba": [0.90, 0.72, 0.12, 1.0], "specular": 0.3, "shininess": 0.4},
    f"band_{PSM2}": {"rgba": [0.16, 0.62, 0.30, 1.0], "specular": 0.3, "shininess": 0.4},
}


def add_materials(spec: mujoco.MjSpec) -> None:
    """Add the materials of the scene and their textures."""
    textures.add_texture(spec, "tissue", textures.tissue())
    textures.add_texture(spec, "drape", textures.cloth())
    for name in ("tray", "metal"):  # slots that only other appearances show
        height, width = appearance.SIZES[name]
        spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            height=height,
            width=width,
        )
    spec.add_numeric(name=appearance.NUMBERS, size=5, data=[0.0] * 5)
    for name, values in MATERIALS.items():
        material = spec.add_material(name=name, **values)
        if name in ("tissue", "drape"):
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def add_surroundings(spec: mujoco.MjSpec) -> None:
    """Add the lights, the sky and the drape."""
    head = spec.visual.headlight
    head.ambient = [0.26, 0.25, 0.25]
    head.diffuse = [0.26, 0.26, 0.26]
    head.specular = [0.25, 0.25, 0.25]
    world = spec.worldbody
    for name, position, direction, strength in (
        ("key", [-0.10, 0.12, 0.45], [0.25, -0.25, -1.0], 0.44),
        ("fill", [0.25, -0.10, 0.35], [-0.7, 0.4, -1.0], 0.16),
    ):
        world.add_light(
            name=name,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=position,
            dir=direction,
            diffuse=[strength, strength, 0.96 * strength],
            specular=[0.5 * strength] * 3,
            castshadow=name == "key",
        )
    falloff = (1.0 - SPOT_NEAR) / appearance.SPOT_DISTANCE**2
    world.add_light(
        name="endoscope",
        type=mujoco.mjtLightType.mjLIGHT_SPOT,
        active=False,
        diffuse=[0.0, 0.0, 0.0],
        specular=[0.0, 0.0, 0.0],
        attenuation=[SPOT_NEAR, 0.0, falloff],
        castshadow=False,  # its shadows would speckle the instruments, and hide behind them
    )
    # In multiples of the extent: a smaller shadow map shows stripes towards its edge.
    spec.visual.map.shadowclip = 9.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.45, 0.55, 0.58],
        rgb2=[0.06, 0.20, 0.23],
        width=32,
        height=192,
    )
    _drape().add_to(spec, "drape")
    show(world, Shape, "drape", meshname="drape")
    distractors.add_distractors(spec)


def dress(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    """Give finished bodies their visible shape and hide the physical geoms beneath it."""
    if config.tissue == "soft":
        hide(spec.body("phantom"))
        soft_skin.add_soft_skin(spec, spec.body("phantom"), config.layout)
    else:
        _dress_phantom(spec, config)
    dress_needle(spec)
    length = INSTRUMENTS[config.instrument].pitch_to_yaw
    tool.add_tool_meshes(spec, length)
    for arm in ARMS:
        shaft = spec.body(f"{arm}_outer_roll_link")
        wrist = spec.body(f"{arm}_outer_wrist_pitch_link")
        hide(shaft)
        hide(wrist)
        tool.dress_shaft(shaft, arm)
        tool.dress_wrist(wrist, length)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            tool.dress_finger(spec.body(f"{arm}_{side}_finger"), sign)


def _dress_phantom(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    body = spec.body("phantom")
    hide(body, keep="pad")
    spec.geom("phantom_pad").material = "flesh"
    skin.add_skin(spec, config.layout)
    for mesh, material in (("skin", "tissue"), ("inside", "inside")):
        show(body, Shape, material, meshname=mesh)
    if config.ink == "alike":
        skin.add_ink(spec, "ink", PAIRS[config.layout])
        show(body, Shape, "ink", meshname="ink")
        return
    for number, pair in enumerate(PAIRS[config.layout], start=1):
        name = skin.ink_of(number)
        skin.add_ink(spec, name, (pair,))
        show(body, Shape, "ink", meshname=name, name=name)
        if number != config.hole_pair:
            spec.geom(name).group = HIDDEN


def dress_needle(spec: mujoco.MjSpec, shape: needle.NeedleShape = needle.OWN_SHAPE) -> None:
    """Draw the needle as one tube along its arc that ends in a point."""
    body = spec.body("needle")
    hide(body)
    angles = np.append(np.linspace(0.0, shape.tip_angle, 33), shape.tip_angle)
    radii = [shape.thickness(angle) for angle in angles]
    centres = np.array([needle.point(angle, shape.radius) for angle in angles])
    radii[-1] = 0.00003
    centres[-1] += needle.tangent(shape.tip_angle) * radii[-2]
    shapes.tube(centres, radii, [0.0, 0.0, -1.0]).add_to(spec, "needle")
    show(body, Shape, "needle", meshname="needle")


def _drape() -> shapes.Mesh:
    """Return a cloth below the tray, flat at the tray and with soft folds around it."""
    columns = np.array([-x for x in reversed(DRAPE_X)] + list(DRAPE_X))
    rows = np.array([x + np.sign(x) * (SIZE[1] - SIZE[0]) / 2 for x in reversed(columns)])
    y, x = np.meshgrid(rows, columns, indexing="ij")
    folds = np.sin(10.0 * x + 2.0 * y) + np.sin(8.0 * y - 3.0 * x) - 2.0
    away = np.clip(np.maximum(np.abs(x) / 0.08, np.abs(y) / 0.13) - 1.0, 0.0, 1.0)
    z = TABLE + DRAPE_WAVE * folds * away
    keep = np.ones((len(rows) - 1, len(columns) - 1), bool)
    keep[len(rows) // 2 - 1, len(columns) // 2 - 1] = False
    mesh = shapes.Mesh()
    mesh.add_grid(
        np.stack([x + ORIGIN[0], y + ORIGIN[1], z], axis=2), np.stack([x, y], axis=2) * 13.0, keep
    )
    return mesh
