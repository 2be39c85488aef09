"""Distractors: other things that lie around: a second needle, gauze, a clip, cut thread, blood.

Interface:

* `Litter(count, seed)` identifies what lies around in one episode; `draw(litter)` returns the
  things with their places.
* `add_distractors(spec)` gives a scene `MOST` hidden geoms on a separate body, "distractors";
  `scatter(source, model, litter)` turns the first of them into the things drawn, and `seen` returns
  how many are shown.

They are only seen: they do not collide and have no mass. In a segmentation they are background, a
second needle too. They lie on the tissue and on the drape next to the tray, clear of the ridge
(`BAND`), of where the needle starts (`START`) and of each other. Their body is posed like anything
that lies on the phantom: it is shifted and turned with it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import mujoco
import numpy as np

from surgicai_vision.core.errors import InputError
from surgicai_vision.scene import needle
from surgicai_vision.scene.holes import SURFACE
from surgicai_vision.scene.phantom import ORIGIN, SIZE, TABLE, TRAY_RIM
from surgicai_vision.scene.rotations import matrix_to_quaternion, quaternion_to_matrix
from surgicai_vision.scene.visual import shapes, textures
from surgicai_vision.scene.visual.fields import Image, fractal, noise, over, shaded, to_bytes
from surgicai_vision.scene.visual.shapes import HIDDEN, VISIBLE, Mesh

BODY = "distractors"
MOST = 5
"""Largest number of distractors in one episode."""
LIFT = 0.00015
"""Height above what they lie on [m], so that it does not show through."""
TRIES = 80
"""Attempts at drawing a free place before another kind is drawn."""
GAP = 0.001
"""Free distance between two of them [m]."""

BAND = 0.014
"""Half of the width of the strip along the wound that stays free [m]: the ridge and the path of a
needle through it."""
START = (needle.HOME[0] - 0.017, needle.HOME[0] + 0.017, needle.HOME[1] - 0.034, 0.200)
"""Where needles start, x from, x to, y from, y to [m]: their radius and spread about `HOME`. The
strip beyond, at the edge of the endoscope's image, is left free."""
ROWS = (-0.005, 0.097)
"""Range of y in which they lie [m]: what both world views show."""

ON_TISSUE = 4.0
"""How many times likelier they are to lie on the tissue than on the drape, per area."""

GAUZE_TEXTURE = (96, 128)
CLOT = (92.0, 8.0, 12.0)


class Zone(NamedTuple):
    """A rectangle that things lie on [m, world of the scene's own model], and its weight."""

    left: float
    right: float
    near: float
    far: float
    height: float
    weight: float = 1.0


_PAD = SIZE[0] / 2 - 0.001
_TRAY = SIZE[0] / 2 + TRAY_RIM + 0.001
ZONES = (
    Zone(ORIGIN[0] + BAND, ORIGIN[0] + _PAD, *ROWS, SURFACE, ON_TISSUE),
    Zone(ORIGIN[0] - _PAD, ORIGIN[0] - BAND, ROWS[0], START[2], SURFACE, ON_TISSUE),
    Zone(ORIGIN[0] + _TRAY, ORIGIN[0] + 0.072, *ROWS, TABLE),
    Zone(ORIGIN[0] - 0.072, ORIGIN[0] - _TRAY, *ROWS, TABLE),
)
"""The tissue on both sides of the strip, and the drape, where it is flat."""


class Thing(NamedTuple):
    """One distractor: its kind, its middle [m], and its turn about z [rad]."""

    kind: str
    place: tuple[float, float, float]
    turn: float


@dataclass(frozen=True)
class Kind:
    """A kind of distractor.

    Attributes:
        mesh: returns its mesh around its middle, lying on z = 0.
        material: its material.
        reach: radius of a circle around its middle that encloses it [m].
    """

    mesh: Callable[[], Mesh]
    material: str
    reach: float


@dataclass(frozen=True)
class Litter:
    """What lies around in an episode.

    Attributes:
        count: number of things, 0 to `MOST`.
        seed: of their kinds and places.
    """

    count: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.count <= MOST:
            raise InputError(f"{self.count} distractors; allowed: 0 to {MOST}.")

    @property
    def numbers(self) -> tuple[float, float]:
        """Return the two floats that a state holds for it."""
        return float(self.count), float(self.seed)

    @classmethod
    def of_numbers(cls, count: float, seed: float) -> "Litter":
        """Return the litter of `numbers`."""
        return cls(int(count), int(seed))


def _needle() -> Mesh:
    """Return a half circle, smaller than the needle and as thick."""
    angles = np.linspace(0.0, math.pi, 33)
    radii = np.minimum(0.0004, 0.0004 * (0.1 + 4.0 * (1.0 - angles / math.pi)))
    curve = 0.0085 * np.stack([np.cos(angles), np.sin(angles) - 0.5, 0.0 * angles], axis=1)
    curve[:, 2] = 0.0004
    return shapes.tube(curve, radii, [0.0, 0.0, 1.0])


def _thread_end() -> Mesh:
    """Return a cut thread that winds over the ground."""
    along = np.linspace(0.0, 1.0, 49)
    bend = np.cumsum(0.16 * np.sin(7.0 * along + 0.6) + 0.09 * np.sin(17.0 * along))
    curve = np.cumsum(
        np.stack([np.cos(bend), np.sin(bend), np.zeros_like(bend)], axis=1) * 0.00058, axis=0
    )
    curve -= (curve.min(axis=0) + curve.max(axis=0)) / 2
    curve[:, 2] = 0.0002
    return shapes.tube(curve, np.full(49, 0.0002), [0.0, 0.0, 1.0], sides=6)


def _clip() -> Mesh:
    """Return a ligation clip, two legs that meet in a bow."""
    legs = [(-0.003, 0.0016), (-0.0005, 0.0013), (0.0018, 0.0009), (0.0026, 0.0005)]
    points = [*legs, (0.0029, 0.0), *((x, -y) for x, y in reversed(legs))]
    curve = np.array([(x, y, 0.0004) for x, y in points])
    return shapes.tube(curve, np.full(len(curve), 0.0004), [0.0, 0.0, 1.0], sides=6)


def _gauze() -> Mesh:
    """Return a folded swab, 15 × 11 mm, two layers with a wavy top."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 15), np.linspace(-1.0, 1.0, 11))
    edge = np.maximum(np.abs(x), np.abs(y))
    height = 0.0009 + 0.0003 * np.sin(5.0 * x + 2.0 * y) + 0.0002 * np.sin(7.0 * y - 3.0 * x)
    height += 0.0006 * (x > 0.15)  # where it is folded over
    height = np.where(edge > 0.99, 0.0, height)
    mesh = Mesh()
    # rows × columns must point upwards, so y falls from row to row.
    points = np.stack([0.0075 * x, -0.0055 * y, height], axis=2)
    mesh.add_grid(points, np.stack([(x + 1.0) / 2.0, (y + 1.0) / 2.0], axis=2))
    return mesh


def _dome(mesh: Mesh, x: float, y: float, radii: list[float], height: float) -> None:
    """Add a flat dome with an uneven edge: `radii` [m] at equal angles."""
    angles = np.append(np.arange(len(radii)), 0.0) * (2.0 * math.pi / len(radii))
    reach = np.array([*radii, radii[0]])
    rings = []
    for share in (0.0, 0.55, 0.85, 1.0):
        z = np.full(len(reach), height * (1.0 - share**3))
        rings.append(
            np.stack(
                [x + share * reach * np.cos(angles), y + share * reach * np.sin(angles), z], axis=1
            )
        )
    mesh.add_grid(np.array(rings))


def _drops() -> Mesh:
    """Return a spatter of drops."""
    mesh = Mesh()
    for x, y, radius in (
        (0.0, 0.0, 2.1),
        (3.6, 1.4, 1.2),
        (-2.9, 2.4, 0.9),
        (-1.6, -3.6, 1.4),
        (2.2, -3.0, 0.6),
        (5.2, -1.6, 0.5),
        (-5.0, -0.6, 0.7),
        (1.2, 4.8, 0.5),
    ):
        edge = [1e-3 * radius * (1.0 + 0.02 * (7 * corner**2 % 11 - 5)) for corner in range(14)]
        _dome(mesh, 1e-3 * x, 1e-3 * y, edge, 0.0003 * radius**0.5)
    return mesh


def _pool() -> Mesh:
    """Return a puddle with lobes."""
    angles = np.arange(36) * (math.pi / 18.0)
    lobes = 0.16 * np.sin(2.0 * angles + 1.0) + 0.12 * np.sin(3.0 * angles)
    edge = 0.0072 * (1.0 + lobes + 0.06 * np.sin(7.0 * angles))
    mesh = Mesh()
    _dome(mesh, 0.0, 0.0, edge.tolist(), 0.0005)
    return mesh


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "needle": Kind(_needle, "needle", 0.0100),
        "gauze": Kind(_gauze, "gauze", 0.0094),
        "clip": Kind(_clip, "steel", 0.0036),
        "thread_end": Kind(_thread_end, "thread", 0.0110),
        "blood_drops": Kind(_drops, "blood", 0.0065),
        "blood_pool": Kind(_pool, "blood", 0.0095),
    }
)


def add_distractors(spec: mujoco.MjSpec) -> None:
    """Add their meshes and materials, and `MOST` hidden geoms on a separate body."""
    textures.add_texture(spec, "gauze", _gauze_texture())
    gauze = spec.add_material(name="gauze", specular=0.0, shininess=0.0)
    gauze.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "gauze"
    spec.add_material(name="blood", rgba=[0.36, 0.016, 0.026, 1.0], specular=0.9, shininess=0.8)
    for name, kind in KINDS.items():
        kind.mesh().add_to(spec, f"distractor_{name}")
    body = spec.worldbody.add_body(name=BODY)
    for index in range(MOST):
        shapes.show(
            body,
            mujoco.mjtGeom.mjGEOM_MESH,
            "blood",
            name=f"distractor_{index}",
            meshname="distractor_clip",
        )
    shapes.hide(body)


def draw(litter: Litter) -> list[Thing]:
    """Draw what lies around; with one seed, a smaller count gives the first of a larger one.

    There are fewer things than requested only if no free place was found.
    """
    rng = np.random.default_rng(litter.seed)
    things: list[Thing] = []
    for _ in range(litter.count):
        for _ in range(len(KINDS)):
            thing = _free(rng, str(rng.choice(tuple(KINDS))), things)
            if thing is not None:
                things.append(thing)
                break
    return things


def _free(rng: np.random.Generator, kind: str, others: list[Thing]) -> Thing | None:
    """Draw a free place for a thing, or None."""
    reach = KINDS[kind].reach
    areas = np.array(
        [
            zone.weight * (zone.right - zone.left - 2 * reach) * (zone.far - zone.near - 2 * reach)
            for zone in ZONES
        ]
    )
    edges = np.cumsum(areas)
    for _ in range(TRIES):
        zone = ZONES[int(np.searchsorted(edges, rng.uniform(0.0, edges[-1])))]
        x = float(rng.uniform(zone.left + reach, zone.right - reach))
        y = float(rng.uniform(zone.near + reach, zone.far - reach))
        turn = float(rng.uniform(-math.pi, math.pi))
        if all(
            math.dist((x, y), other.place[:2]) > reach + KINDS[other.kind].reach + GAP
            for other in others
        ):
            return Thing(kind, (x, y, zone.height + LIFT), turn)
    return None


def scatter(source: mujoco.MjModel, model: mujoco.MjModel, litter: Litter) -> None:
    """Show what lies around in `model`, a copy of the compiled `source`, which is only read."""
    things = draw(litter)
    for index in range(MOST):
        geom = source.geom(f"distractor_{index}").id
        model.geom_group[geom] = HIDDEN
        if index >= len(things):
            continue
        kind, place, turn = things[index]
        mesh = source.mesh(f"distractor_{kind}").id
        rotation = np.array(
            [
                [math.cos(turn), -math.sin(turn), 0.0],
                [math.sin(turn), math.cos(turn), 0.0],
                [0.0, 0.0, 1.0],
            ]
        )
        # The compiler has moved a mesh to its centre of mass and its principal axes.
        model.geom_pos[geom] = place + rotation @ source.mesh_pos[mesh]
        model.geom_quat[geom] = matrix_to_quaternion(
            rotation @ quaternion_to_matrix(source.mesh_quat[mesh])
        )
        model.geom_dataid[geom] = mesh
        model.geom_matid[geom] = source.material(KINDS[kind].material).id
        model.geom_group[geom] = VISIBLE


def seen(model: mujoco.MjModel) -> int:
    """Return how many distractors a model shows."""
    groups = [model.geom(f"distractor_{index}").group[0] for index in range(MOST)]
    return sum(int(group == VISIBLE) for group in groups)


def _gauze_texture() -> Image:
    """Draw white gauze of crossing threads, soaked in blood at one end."""
    rng = np.random.default_rng(7)
    height, width = GAUZE_TEXTURE
    weave = np.maximum(np.arange(height)[:, None] % 4 < 2, np.arange(width) % 4 < 2)
    share = 0.7 * weave + 0.3 * noise(rng, GAUZE_TEXTURE, 24, 32)
    image = shaded(share.astype(np.float32), (150.0, 150.0, 146.0), (244.0, 244.0, 238.0))
    away = (np.arange(width) / width - 0.45).astype(np.float32) * np.float32(3.0)
    stain = np.clip(away + fractal(rng, GAUZE_TEXTURE, 4, 5, 3) - np.float32(0.5), 0, 1)
    return to_bytes(over(image, CLOT, 0.85 * stain))
