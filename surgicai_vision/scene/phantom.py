"""Phantom: a tissue pad with a ridge along y; the four hole pairs open on the ridge's two flanks.

In tissue with channels only the walls are solid: each flank is a plate of `WALL` thickness with
square openings, so the needle runs freely inside the ridge, as in SurgicAI's phantom, whose holes
are mounted on springs. The openings are wide for the same reason as there: the needle's arc meets
them 21° off their axis. Soft tissue has no openings (`scene.tissue`).

Tissue yields to steel: the jaws may dent the pad by `DENT` before they meet its firm layer, while
the needle, a hundred times lighter, lies on its surface. Without the dent, jaws whose pads reach
past the grasp point could not grasp a needle that lies flat.
"""

import itertools
import math

import mujoco
import numpy as np

from surgicai_vision.scene.holes import OPENING, PAIRS, SURFACE, Hole, HolePair

SIZE = (0.0797, 0.173, 0.0393)
"""Extent of the phantom [m] (SurgicAI)."""
ORIGIN = (0.0, 0.01476)
"""Centre of the phantom in x and y [m, world] (SurgicAI)."""
WALL = 0.0010
"""Thickness of the flanks [m]."""
DENT = 0.0025
"""How far the jaws may dent the tissue [m]."""
CREST = 0.0012
"""Radius of the ridge's rounded top [m]."""
BEYOND = 0.006
"""How far the ridge extends beyond the first and the last hole pair [m]: not far, because the tools
approach along the wound and their wrists need the room."""

TRAY_RIM = 0.007
"""How far the tray under the phantom extends beyond it [m]."""
TRAY_HEIGHT = 0.012
"""Height of that tray [m]."""
CLEARANCE = 0.002
"""Between the phantom's underside and the table [m]; the phantom is sunk into the tray."""
TABLE = SURFACE - SIZE[2] - CLEARANCE
"""Height of the table's top [m]."""

CONTACT = {
    "condim": 3,
    "friction": [0.4, 0.002, 0.0001],
    "solref": [0.008, 1.0],
    "solimp": [0.945, 0.9745, 0.00055, 0.5, 2.0],
    "priority": 1,
}
"""Friction of 0.4 between wet tissue and steel. It takes effect by priority, because MuJoCo would
otherwise use the larger friction of a pair, the 1.0 of needle and jaws. The impedance is the mean
of theirs and MuJoCo's default, which MuJoCo would use at equal priority. With a time constant of
8 ms an arm that runs into the tissue strikes it with at most 14 N, with 4 ms 29 N
(`benchmarks/press.py`)."""


def add_phantom(
    spec: mujoco.MjSpec,
    layout: str,
    needle: dict[str, int],
    arm: dict[str, int],
    ridge: dict[str, int],
    *,
    is_solid: bool,
) -> None:
    """Add the phantom to `spec` as one fixed body.

    Args:
        spec: the scene.
        layout: a key of `holes.PAIRS`.
        needle: collision bits of what the needle and thread touch.
        arm: collision bits of what the instruments touch.
        ridge: collision bits of the ridge's flanks and crest.
        is_solid: no holes; `scene.tissue` adds what the needle meets there.
    """
    body = spec.worldbody.add_body(name="phantom")
    add_flank = _add_solid_flank if is_solid else _add_flank
    half = [side / 2 for side in SIZE]
    for name, top, bits, group in (("pad", SURFACE, needle, 0), ("firm", SURFACE - DENT, arm, 4)):
        body.add_geom(
            name=f"phantom_{name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*ORIGIN, top - half[2]],
            size=half,
            material="tissue",
            group=group,
            **CONTACT,
            **bits,
        )
    pairs = PAIRS[layout]
    edges = piece_edges(pairs)
    for index, (pair, start, end) in enumerate(
        zip(pairs, edges[:-1], edges[1:], strict=True), start=1
    ):
        for side, hole in (("entry", pair.entry), ("exit", pair.exit)):
            add_flank(
                body, f"phantom_{side}{index}", hole, start, end, flank_height(pair, hole), ridge
            )
        add_crest(body, f"phantom_crest{index}", pair, start, end, ridge)


def add_table(spec: mujoco.MjSpec, bits: dict[str, int]) -> None:
    """Add the tray and the table below, where a needle that falls from the phantom rests.

    They are solid only for the needle and the thread: no instrument is meant to come that low.

    Args:
        spec: the scene.
        bits: collision bits of what the needle and the thread touch.
    """
    half = [SIZE[0] / 2 + TRAY_RIM, SIZE[1] / 2 + TRAY_RIM, TRAY_HEIGHT / 2]
    place = {"pos": [*ORIGIN, TABLE + half[2]], "size": half, "material": "tray", "group": 0}
    tray = spec.worldbody.add_body(name="tray")
    tray.add_geom(name="tray", type=mujoco.mjtGeom.mjGEOM_BOX, **place, **CONTACT, **bits)
    flat = {"pos": [*ORIGIN, TABLE], "size": [0.0, 0.0, 1.0], "group": 4}
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, **flat, **CONTACT, **bits
    )


def piece_edges(pairs: tuple[HolePair, ...]) -> list[float]:
    """Return the five y [m], descending, that divide the ridge into one piece per hole pair."""
    rows = [pair.entry.centre[1] for pair in pairs]
    between = [(first + second) / 2 for first, second in itertools.pairwise(rows)]
    return [rows[0] + BEYOND, *between, rows[-1] - BEYOND]


def flank_height(pair: HolePair, hole: Hole) -> float:
    """Return the length of the flank from the hole's centre up to the crest [m]."""
    return (pair.gap / 2 - CREST * math.sin(abs(hole.tilt))) / math.cos(hole.tilt)


def _add_flank(
    body: mujoco.MjsBody,
    name: str,
    hole: Hole,
    start: float,
    end: float,
    rise: float,
    bits: dict[str, int],
) -> None:
    """Add the four boxes that frame one opening, from the crest down to the pad."""
    opening = OPENING / 2
    drop = flank_depth(hole)
    near = end - hole.centre[1]
    far = start - hole.centre[1]
    rectangles = {
        "top": (opening, rise, near, far),
        "bottom": (-drop, -opening, near, far),
        "left": (-opening, opening, near, -opening),
        "right": (-opening, opening, opening, far),
    }
    for part, (low, high, first, last) in rectangles.items():
        add_plate(body, f"{name}_{part}", hole, (low, high), (first, last), WALL, CONTACT | bits)


def _add_solid_flank(
    body: mujoco.MjsBody,
    name: str,
    hole: Hole,
    start: float,
    end: float,
    rise: float,
    bits: dict[str, int],
) -> None:
    """Add one box without an opening, from the crest down to the pad."""
    across = (end - hole.centre[1], start - hole.centre[1])
    add_plate(body, name, hole, (-flank_depth(hole), rise), across, WALL, CONTACT | bits)


def flank_depth(hole: Hole) -> float:
    """Return the length of the flank from the hole's centre down into the pad [m]."""
    return (hole.centre[2] - SURFACE) / math.sin(abs(hole.tilt)) + WALL


def add_plate(
    body: mujoco.MjsBody,
    name: str,
    hole: Hole,
    along: tuple[float, float],
    across: tuple[float, float],
    thickness: float,
    contact: dict[str, object],
) -> None:
    """Add a box whose outer face is a rectangle in a hole's plane.

    Args:
        body: the phantom.
        name: of the geom.
        hole: gives the plane.
        along: where the rectangle begins and ends, up the flank from the hole's centre [m].
        across: the same along the wound [m].
        thickness: of the box [m].
        contact: collision bits and contact parameters.
    """
    low, high = along
    first, last = across
    up = -math.copysign(1.0, hole.tilt)
    local = np.array([up * (low + high) / 2, (first + last) / 2, -thickness / 2])
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(np.asarray(hole.centre) + hole.rotation @ local).tolist(),
        quat=[math.cos(hole.tilt / 2), 0.0, math.sin(hole.tilt / 2), 0.0],
        size=[(high - low) / 2, (last - first) / 2, thickness / 2],
        material="tissue",
        **contact,
    )


def add_crest(
    body: mujoco.MjsBody, name: str, pair: HolePair, start: float, end: float, bits: dict[str, int]
) -> None:
    """Add the ridge's rounded top, touching the upper ends of both flanks from inside."""
    tilt = abs(pair.entry.tilt)
    rise = flank_height(pair, pair.entry)
    x = (pair.entry.centre[0] + pair.exit.centre[0]) / 2
    z = pair.entry.centre[2] + rise * math.sin(tilt) - CREST * math.cos(tilt)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[x, end, z, x, start, z],
        size=[CREST, 0, 0],
        material="tissue",
        **CONTACT,
        **bits,
    )
