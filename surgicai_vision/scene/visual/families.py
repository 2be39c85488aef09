"""Families: what belongs together in one appearance, and the bounds within which an episode draws.

`FAMILIES` is the table, in the order of `names.APPEARANCES`. A `varied_` family is one for training
with random surroundings (`cloths.varied`), of any colour. A `random_` family is the same with a
random tissue, random instruments and random light. No pattern, finish, lamp or colour of a held-out
family is used in a training family (tested in `tests/scene/test_appearance.py`), but the random
colours and lights come close to some of theirs by chance. Colours are 0 to 255; they and all bounds
were chosen by eye on the contact sheets (`surgicai-vision scene --looks FILE`), not measured on
tissue.
"""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from surgicai_vision.core import names
from surgicai_vision.scene.visual import cloths, tissues
from surgicai_vision.scene.visual.fields import Colour, Pattern
from surgicai_vision.scene.visual.random_patterns import any_tissue

Bounds = tuple[float, float]


@dataclass(frozen=True)
class Finish:
    """A material: a colour between two, its specular strength and its shininess (MuJoCo's)."""

    first: Colour
    second: Colour
    specular: Bounds = (0.1, 0.3)
    shininess: Bounds = (0.2, 0.4)


@dataclass(frozen=True)
class Lamps:
    """The light of a family.

    Attributes:
        warm: one end of the light's colour.
        cool: its other end.
        ambient: strength of the light from everywhere.
        head: of the light at each camera.
        key: of the lamp over the scene, the one that casts shadows.
        lean: largest tangent of its angle to the vertical, along x and y.
        fill: of a second lamp from the side.
        spot: of the endoscope's light at the distance `appearance.SPOT_DISTANCE`; it falls off with
            the square of the distance. 0 switches it off.
        cutoff: half of the spot's cone [deg].
        exponent: how fast the spot darkens from its axis (OpenGL's).
        glare: specular strength of all of them, as a share of the diffuse one.
    """

    warm: Colour
    cool: Colour
    ambient: Bounds
    head: Bounds
    key: Bounds
    lean: float
    fill: Bounds
    spot: Bounds = (0.0, 0.0)
    cutoff: Bounds = (40.0, 50.0)
    exponent: Bounds = (4.0, 8.0)
    glare: Bounds = (0.4, 0.7)


@dataclass(frozen=True)
class Family:
    """One family of looks; each episode draws its own look within it.

    Attributes:
        tissue: pattern of the skin's texture.
        wet: the skin's material over that texture: tint, specular strength, shininess.
        flesh: the phantom's sides.
        inside: what is visible in a hole.
        ink: the marks.
        drape: pattern of the cloth.
        tray: pattern of the tray; `tray_finish` tints it.
        metal: pattern of the instruments; `steel` and `jaw` tint it.
        needle: the needle.
        thread: the thread.
        steel: wrist and fingers.
        jaw: pads and pins.
        shaft: the shafts.
        lamps: the light.
    """

    tissue: Pattern
    wet: Finish
    flesh: Finish
    inside: Finish
    ink: Finish
    drape: Pattern
    tray: Pattern
    tray_finish: Finish
    metal: Pattern
    needle: Finish
    thread: Finish
    steel: Finish
    jaw: Finish
    shaft: Finish
    lamps: Lamps


BRIGHT = Finish((246.0, 248.0, 255.0), (230.0, 234.0, 240.0), (0.9, 1.0), (0.8, 0.95))
BLACK = Finish((26.0, 27.0, 31.0), (44.0, 44.0, 50.0), (0.6, 0.9), (0.6, 0.8))
WORN = Finish((176.0, 170.0, 160.0), (146.0, 136.0, 124.0), (0.3, 0.6), (0.3, 0.5))
BLUED = Finish((70.0, 82.0, 136.0), (88.0, 84.0, 116.0), (0.7, 1.0), (0.6, 0.8))
GILT = Finish((206.0, 168.0, 96.0), (190.0, 146.0, 104.0), (0.7, 1.0), (0.6, 0.85))
ETCHED = Finish((214.0, 218.0, 212.0), (190.0, 200.0, 204.0), (0.05, 0.2), (0.1, 0.2))
"""Needles: polished, coated, used; held out: blued, gilt, etched dull."""

POLISHED = Finish((156.0, 160.0, 168.0), (140.0, 143.0, 152.0), (0.8, 1.0), (0.6, 0.8))
MATT = Finish((128.0, 130.0, 134.0), (108.0, 108.0, 112.0), (0.2, 0.4), (0.2, 0.4))
DARK_JAW = Finish((92.0, 94.0, 102.0), (76.0, 78.0, 84.0), (0.4, 0.7), (0.4, 0.6))
CARBON = Finish((34.0, 35.0, 39.0), (46.0, 46.0, 50.0), (0.5, 0.8), (0.5, 0.7))
TITANIUM = Finish((146.0, 138.0, 150.0), (122.0, 122.0, 142.0), (0.5, 0.8), (0.4, 0.6))
COATED = Finish((70.0, 66.0, 62.0), (88.0, 84.0, 74.0), (0.2, 0.4), (0.2, 0.4))
GREY_SHAFT = Finish((104.0, 106.0, 108.0), (134.0, 134.0, 130.0), (0.3, 0.5), (0.3, 0.5))
"""Instruments; the last three are held out."""

ROOM = Lamps(
    (255.0, 246.0, 232.0),
    (240.0, 248.0, 255.0),
    ambient=(0.20, 0.28),
    head=(0.22, 0.30),
    key=(0.36, 0.50),
    lean=0.35,
    fill=(0.10, 0.20),
)
THEATRE = Lamps(
    (255.0, 236.0, 208.0),
    (255.0, 250.0, 244.0),
    ambient=(0.14, 0.22),
    head=(0.10, 0.20),
    key=(0.55, 0.75),
    lean=0.7,
    fill=(0.05, 0.15),
    glare=(0.5, 0.9),
)
ENDOSCOPE = Lamps(
    (255.0, 244.0, 230.0),
    (236.0, 244.0, 255.0),
    ambient=(0.12, 0.18),
    head=(0.06, 0.14),
    key=(0.10, 0.20),
    lean=0.3,
    fill=(0.0, 0.10),
    spot=(0.55, 0.78),
    glare=(0.3, 0.6),
)
NARROW = Lamps(
    (236.0, 246.0, 255.0),
    (214.0, 232.0, 255.0),
    ambient=(0.16, 0.20),
    head=(0.10, 0.16),
    key=(0.02, 0.08),
    lean=0.2,
    fill=(0.0, 0.05),
    spot=(1.10, 1.35),
    cutoff=(38.0, 46.0),
    exponent=(14.0, 24.0),
    glare=(0.8, 1.1),
)
SUNSET = Lamps(
    (255.0, 210.0, 158.0),
    (255.0, 222.0, 184.0),
    ambient=(0.20, 0.26),
    head=(0.10, 0.18),
    key=(0.62, 0.80),
    lean=1.3,
    fill=(0.0, 0.06),
    glare=(0.4, 0.8),
)
TUBES = Lamps(
    (222.0, 255.0, 226.0),
    (206.0, 240.0, 255.0),
    ambient=(0.34, 0.42),
    head=(0.18, 0.26),
    key=(0.20, 0.30),
    lean=0.15,
    fill=(0.20, 0.30),
    glare=(0.1, 0.3),
)
"""Light: a room, a theatre's lamp, an endoscope; held out: a narrow cold spot, low warm light from
the side, cold tubes without direction."""

_DRAWN: Mapping[str, Family] = MappingProxyType(
    {
        "silicone": Family(
            tissue=tissues.silicone,
            wet=Finish((255.0, 255.0, 255.0), (244.0, 240.0, 236.0), (0.1, 0.3), (0.2, 0.4)),
            flesh=Finish((214.0, 170.0, 150.0), (200.0, 152.0, 138.0)),
            inside=Finish((92.0, 40.0, 36.0), (74.0, 26.0, 26.0)),
            ink=Finish((42.0, 28.0, 108.0), (24.0, 40.0, 96.0)),
            drape=cloths.woven,
            tray=cloths.pitted,
            tray_finish=Finish((214.0, 216.0, 214.0), (170.0, 190.0, 206.0)),
            metal=cloths.brushed,
            needle=BRIGHT,
            thread=Finish((20.0, 14.0, 44.0), (20.0, 20.0, 24.0)),
            steel=POLISHED,
            jaw=DARK_JAW,
            shaft=CARBON,
            lamps=ROOM,
        ),
        "mucosa": Family(
            tissue=tissues.mucosa,
            wet=Finish((255.0, 255.0, 255.0), (255.0, 236.0, 232.0), (0.4, 0.7), (0.4, 0.7)),
            flesh=Finish((178.0, 92.0, 86.0), (160.0, 76.0, 78.0)),
            inside=Finish((80.0, 16.0, 20.0), (62.0, 10.0, 20.0)),
            ink=Finish((30.0, 22.0, 74.0), (22.0, 18.0, 40.0)),
            drape=cloths.fleece,
            tray=cloths.brushed,
            tray_finish=Finish((182.0, 186.0, 190.0), (150.0, 154.0, 160.0), (0.4, 0.7)),
            metal=cloths.brushed,
            needle=BRIGHT,
            thread=Finish((32.0, 44.0, 120.0), (16.0, 30.0, 84.0)),
            steel=POLISHED,
            jaw=DARK_JAW,
            shaft=CARBON,
            lamps=ENDOSCOPE,
        ),
        "skin": Family(
            tissue=tissues.skin,
            wet=Finish((255.0, 255.0, 255.0), (255.0, 246.0, 238.0), (0.05, 0.2), (0.1, 0.3)),
            flesh=Finish((196.0, 116.0, 96.0), (170.0, 96.0, 80.0)),
            inside=Finish((104.0, 26.0, 26.0), (80.0, 18.0, 20.0)),
            ink=Finish((56.0, 24.0, 112.0), (30.0, 20.0, 60.0)),
            drape=cloths.crepe,
            tray=cloths.pitted,
            tray_finish=Finish((96.0, 136.0, 178.0), (128.0, 168.0, 184.0)),
            metal=cloths.scratched,
            needle=WORN,
            thread=Finish((18.0, 18.0, 20.0), (34.0, 30.0, 30.0)),
            steel=MATT,
            jaw=DARK_JAW,
            shaft=CARBON,
            lamps=THEATRE,
        ),
        "muscle": Family(
            tissue=tissues.muscle,
            wet=Finish((255.0, 255.0, 255.0), (255.0, 240.0, 236.0), (0.3, 0.6), (0.4, 0.6)),
            flesh=Finish((136.0, 44.0, 42.0), (112.0, 30.0, 34.0)),
            inside=Finish((60.0, 8.0, 12.0), (46.0, 6.0, 14.0)),
            ink=Finish((22.0, 20.0, 46.0), (14.0, 12.0, 20.0)),
            drape=cloths.woven,
            tray=cloths.brushed,
            tray_finish=Finish((176.0, 178.0, 180.0), (140.0, 142.0, 148.0), (0.4, 0.7)),
            metal=cloths.scratched,
            needle=WORN,
            thread=Finish((24.0, 96.0, 66.0), (20.0, 70.0, 60.0)),
            steel=MATT,
            jaw=DARK_JAW,
            shaft=CARBON,
            lamps=ENDOSCOPE,
        ),
        "fat": Family(
            tissue=tissues.fat,
            wet=Finish((255.0, 255.0, 255.0), (255.0, 246.0, 226.0), (0.3, 0.6), (0.3, 0.6)),
            flesh=Finish((210.0, 158.0, 84.0), (190.0, 136.0, 84.0)),
            inside=Finish((120.0, 52.0, 30.0), (92.0, 34.0, 24.0)),
            ink=Finish((34.0, 24.0, 92.0), (20.0, 20.0, 40.0)),
            drape=cloths.fleece,
            tray=cloths.brushed,
            tray_finish=Finish((190.0, 192.0, 190.0), (158.0, 164.0, 168.0), (0.3, 0.6)),
            metal=cloths.brushed,
            needle=BLACK,
            thread=Finish((38.0, 66.0, 160.0), (24.0, 44.0, 120.0)),
            steel=POLISHED,
            jaw=DARK_JAW,
            shaft=CARBON,
            lamps=THEATRE,
        ),
        "liver": Family(
            tissue=tissues.liver,
            wet=Finish((255.0, 252.0, 250.0), (250.0, 236.0, 230.0), (0.7, 1.0), (0.6, 0.8)),
            flesh=Finish((88.0, 36.0, 32.0), (72.0, 28.0, 28.0)),
            inside=Finish((40.0, 8.0, 10.0), (30.0, 4.0, 8.0)),
            ink=Finish((232.0, 232.0, 214.0), (206.0, 222.0, 226.0)),
            drape=cloths.film,
            tray=cloths.tarnished,
            tray_finish=Finish((70.0, 74.0, 80.0), (96.0, 98.0, 100.0), (0.4, 0.7)),
            metal=cloths.tarnished,
            needle=GILT,
            thread=Finish((226.0, 220.0, 200.0), (200.0, 204.0, 196.0)),
            steel=TITANIUM,
            jaw=COATED,
            shaft=GREY_SHAFT,
            lamps=NARROW,
        ),
        "bowel": Family(
            tissue=tissues.bowel,
            wet=Finish((255.0, 254.0, 252.0), (246.0, 238.0, 240.0), (0.6, 0.9), (0.6, 0.9)),
            flesh=Finish((190.0, 140.0, 132.0), (170.0, 128.0, 126.0)),
            inside=Finish((124.0, 36.0, 44.0), (100.0, 26.0, 40.0)),
            ink=Finish((16.0, 70.0, 58.0), (14.0, 86.0, 108.0)),
            drape=cloths.towel,
            tray=cloths.tarnished,
            tray_finish=Finish((206.0, 180.0, 130.0), (186.0, 166.0, 140.0), (0.2, 0.5)),
            metal=cloths.tarnished,
            needle=BLUED,
            thread=Finish((146.0, 60.0, 160.0), (120.0, 50.0, 130.0)),
            steel=TITANIUM,
            jaw=COATED,
            shaft=GREY_SHAFT,
            lamps=SUNSET,
        ),
        "scar": Family(
            tissue=tissues.scar,
            wet=Finish((255.0, 252.0, 252.0), (246.0, 240.0, 244.0), (0.1, 0.3), (0.1, 0.4)),
            flesh=Finish((160.0, 92.0, 92.0), (146.0, 84.0, 92.0)),
            inside=Finish((88.0, 14.0, 36.0), (66.0, 8.0, 30.0)),
            ink=Finish((10.0, 64.0, 40.0), (4.0, 44.0, 60.0)),
            drape=cloths.checked,
            tray=cloths.tarnished,
            tray_finish=Finish((92.0, 130.0, 96.0), (116.0, 140.0, 104.0)),
            metal=cloths.tarnished,
            needle=ETCHED,
            thread=Finish((190.0, 150.0, 60.0), (170.0, 120.0, 70.0)),
            steel=TITANIUM,
            jaw=COATED,
            shaft=GREY_SHAFT,
            lamps=TUBES,
        ),
    }
)
ANY_TRAY = Finish((255.0, 255.0, 255.0), (235.0, 235.0, 235.0), (0.1, 0.7), (0.2, 0.7))
"""A tray whose texture has its colour."""

ANY_WET = Finish((255.0, 255.0, 255.0), (255.0, 240.0, 232.0), (0.05, 1.0), (0.1, 0.95))
"""A skin of any wetness whose texture has its colour."""
ANY_FLESH = Finish((232.0, 204.0, 184.0), (62.0, 24.0, 26.0))
ANY_INSIDE = Finish((116.0, 52.0, 46.0), (28.0, 6.0, 12.0))
ANY_INK = Finish((34.0, 26.0, 60.0), (12.0, 20.0, 18.0))
"""Darker than any random tissue."""
ANY_STEEL = Finish((196.0, 196.0, 200.0), (84.0, 82.0, 88.0), (0.1, 1.0), (0.1, 0.9))
ANY_JAW = Finish((128.0, 126.0, 130.0), (44.0, 44.0, 48.0), (0.1, 0.9), (0.1, 0.9))
ANY_SHAFT = Finish((146.0, 146.0, 146.0), (24.0, 24.0, 28.0), (0.2, 0.8), (0.2, 0.8))
ANY_LAMPS = Lamps(
    (255.0, 206.0, 150.0),
    (196.0, 232.0, 255.0),
    ambient=(0.12, 0.40),
    head=(0.08, 0.30),
    key=(0.02, 0.70),
    lean=1.2,
    fill=(0.0, 0.30),
    spot=(0.0, 0.90),
    cutoff=(36.0, 55.0),
    exponent=(2.0, 24.0),
    glare=(0.1, 1.1),
)
"""The rest of a random look. Needle and thread stay those of the family."""


def _with_any_surroundings(family: Family) -> Family:
    """Return a family over a random cloth and in a random tray."""
    return dataclasses.replace(
        family, drape=cloths.varied, tray=cloths.varied, tray_finish=ANY_TRAY
    )


def _with_anything(family: Family) -> Family:
    """Return a family with random surroundings, tissue, instruments and light."""
    return dataclasses.replace(
        _with_any_surroundings(family),
        tissue=functools.partial(any_tissue, family.tissue),
        wet=ANY_WET,
        flesh=ANY_FLESH,
        inside=ANY_INSIDE,
        ink=ANY_INK,
        steel=ANY_STEEL,
        jaw=ANY_JAW,
        shaft=ANY_SHAFT,
        lamps=ANY_LAMPS,
    )


_TRAINED = tuple(_DRAWN[name] for name in names.TRAIN_APPEARANCES)
FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        **_DRAWN,
        **dict(zip(names.VARIED_APPEARANCES, map(_with_any_surroundings, _TRAINED), strict=True)),
        **dict(zip(names.RANDOM_APPEARANCES, map(_with_anything, _TRAINED), strict=True)),
    }
)
