"""Soft tissue: its part of the MuJoCo model, and the forces with which it resists.

`add_soft_tissue` turns the phantom's ridge into tissue without holes that can be pierced anywhere.
What happens during an episode, when the skin is pierced and what is held where, is in
`envs.tissue`. The elements:

* Skin: on each flank a thick box that only the needle meets, with the stiffness `skin_stiffness`.
  It gives way before it is pierced. The jaws and the thread meet the flank as they do in tissue
  with channels.
* Two carriers: weightless bodies on hinges through the centre of the needle's arc. The site on
  each is a point of the needle that can slide along the arc.
* Two holds: `connect` equalities between a carrier's site and an anchor, a mocap body. Along the
  arc the hinge is free except for its `frictionloss`, the friction of the needle's shaft; across it
  the equality is the lateral spring of the tissue. Solved as constraints, both are stable at 2 ms:
  an explicit spring of 0.5 N/mm on a needle of 0.2 g would not be.
* Holds of the thread, `THREAD_HOLDS` of them: the same between a capsule of the thread and a
  slider. The slider glides along the thread through its anchor, and its `frictionloss` is the
  thread's friction. Which capsule is held, and where on it, is updated as the thread goes through.
  The sliders of a bite's entry and exit move together: between them the thread has no slack.

Every force is a field of `TissueForces`; `docs/tissue.md` says what is known and what is chosen.
"""

import math
from dataclasses import dataclass
from types import MappingProxyType

import mujoco

from surgicai_vision.scene import needle, phantom
from surgicai_vision.scene.holes import PAIRS

THICKNESS = 0.0025
"""Thickness of the skin's boxes [m]: a box pushes a needle out of its nearest face, so it must be
thicker than the dent at which the skin is pierced."""
STIFFENING = 10.0
"""How much stiffer the skin is when it is dented by its whole thickness."""
LATE = 6.0
"""How late over its width a stiffness changes: the power in MuJoCo's solimp."""
RESPONSE = 62500.0
"""Stiffness of the reference acceleration of skin and holds [1/s²], as for the 4 ms of the scene's
other contacts. Anything light diverges above 1/dt² = 250,000."""
FRICTION_SOLREF = (0.004, 1.0)
FRICTION_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""For the shaft's friction. With MuJoCo's default it creeps, and holds 0.15 N instead of 0.62 N."""
CARRIER_MASS = 1e-6
"""[kg]; the two weigh 1 % of the needle."""
CARRIER_ARMATURE = 1e-7
"""[kg·m²]: along the arc a carrier is as inert as 1 g, which 2 ms can resolve."""
CARRIER_DAMPING = 2e-7
"""[N·m·s/rad]; below 2 I / dt, as the scene's damping is explicit."""
THREAD_HOLDS = 4
"""Places that can hold the thread: entry and exit of the last two bites."""
THREAD_STIFFNESS = 200.0
"""Stiffness across the thread, at each place that holds it [N/m]."""
THREAD_REACH = 0.0083
THREAD_SOFTENING = 0.2
"""From this distance on [m] the hold is softer by this factor: up to 8 mm it pulls with at most
0.4 N, which 2 ms can resolve. With 500 N/m and 0.8 N, four of 150 random episodes at 75 mm/s ended
in a physics error; with these values none of 300."""
SLIDER_ARMATURE = 1e-3
"""[kg]: inert enough for 2 ms to resolve; moving it at 25 mm/s takes a hundredth of the
friction."""
HIDDEN = (0.0, 0.0, -0.1)
"""Where anchors that hold nothing are kept [m, world]."""
Spring = tuple[tuple[float, float], tuple[float, float, float, float, float]]
"""solref and solimp of a constraint."""
SOFT_DATA = 520
"""How many numbers `envs.tissue` keeps inside MuJoCo's state."""


@dataclass(frozen=True)
class TissueForces:
    """How tissue resists a suture needle and its thread.

    The components are those that Okamura, Simone and O'Leary (IEEE Transactions on Biomedical
    Engineering 51:1707, 2004) found in needle insertions: stiffness before the puncture, then
    friction proportional to the depth, and a constant cutting force. Across the shaft they are
    those of Jackson and Çavuşoğlu (ICRA 2012): a needle off its own arc compresses the tissue.
    None depends on the speed (Frick et al., Journal of Biomechanics 34:1335, 2001: 1 to 10 mm/s).

    Attributes:
        skin_stiffness: force on the tip per depth of the dent before it is pierced [N/m].
        skin_friction: coefficient of friction between needle and skin.
        puncture_in: force on the tip at which the skin is pierced [N].
        puncture_out: the same from inside, where the tip leaves [N].
        cutting: force on the tip while it cuts through tissue [N].
        friction: force along the shaft per embedded length [N/m].
        lateral_stiffness: force across the shaft per displacement, at each place that holds [N/m].
        yield_force: force across the shaft beyond which part of the displacement is permanent [N].
        hardening: by how much that force grows per permanent displacement [N/m].
        tear_force: force across the shaft at which the tissue tears, down to `yield_force` [N].
        thread_friction: force along the thread per length of the bite [N/m].
    """

    skin_stiffness: float
    skin_friction: float
    puncture_in: float
    puncture_out: float
    cutting: float
    friction: float
    lateral_stiffness: float
    yield_force: float
    hardening: float
    tear_force: float
    thread_friction: float

    @property
    def dent_in(self) -> float:
        """Return how deep the needle's tip dents the skin before it goes through [m].

        The contact begins half a tip's thickness before the tip's middle.
        """
        return self.puncture_in / self.skin_stiffness - needle.TIP_RADIUS

    def give_way(self, distance: float, yielded: float) -> tuple[float, float, bool]:
        """Return how an anchor gives way to the shaft that it holds.

        Elastic up to the yield force, then isotropic hardening, then a tear: the anchor follows
        until the yield force is left, in tissue that has not yielded yet.

        Args:
            distance: of what is held from its anchor [m].
            yielded: permanent displacement of the anchor so far [m].

        Returns:
            The share of `distance` by which the anchor moves, the permanent displacement after that
            [m], and whether the tissue tore.
        """
        force = self.lateral_stiffness * distance
        excess = force - self.yield_force - self.hardening * yielded
        if excess <= 0.0:
            return 0.0, yielded, False
        if force > self.tear_force:
            return 1.0 - self.yield_force / force, 0.0, True
        way = excess / (self.lateral_stiffness + self.hardening)
        return way / distance, yielded + way, False


FORCES = MappingProxyType(
    {
        "phantom": TissueForces(
            skin_stiffness=1500.0,
            skin_friction=0.3,
            puncture_in=1.5,
            puncture_out=1.0,
            cutting=0.1,
            friction=75.0,
            lateral_stiffness=1000.0,
            yield_force=1.5,
            hardening=1000.0,
            tear_force=3.0,
            thread_friction=20.0,
        ),
        "skin": TissueForces(
            skin_stiffness=1000.0,
            skin_friction=0.3,
            puncture_in=1.0,
            puncture_out=0.7,
            cutting=0.15,
            friction=60.0,
            lateral_stiffness=1500.0,
            yield_force=3.2,
            hardening=1500.0,
            tear_force=6.0,
            thread_friction=25.0,
        ),
        "liver": TissueForces(
            skin_stiffness=600.0,
            skin_friction=0.2,
            puncture_in=0.6,
            puncture_out=0.4,
            cutting=0.05,
            friction=25.0,
            lateral_stiffness=300.0,
            yield_force=0.4,
            hardening=300.0,
            tear_force=1.0,
            thread_friction=8.0,
        ),
    }
)
"""Preset → forces. No publication gives all of them for a needle of 0.9 mm, so most are chosen:

* "phantom": ours, a training phantom that is firmer than tissue. The curve over depth has the two
  peaks, on the way in and on the way out, that Frick et al. measured in sheepskin.
* "skin": `puncture_in` is the largest mean of Maloney et al. (Dermatologic Surgery, 2021: 0.48 to
  1.00 N, tapered and cutting needles of 3-0 to 5-0 in human abdominal skin); `yield_force` is the
  largest force with which a stitch closed a wound (Capek et al., Medical & Biological Engineering &
  Computing 50:193, 2012: 1.1 to 3.2 N), which skin must bear. The ratio of cutting to friction over
  a bite of 8 mm is ours: for hollow needles Barnett et al. (Journal of Manufacturing Science and
  Engineering, 2015) give 61 % to tearing, 18 % to spreading, 21 % to friction. The rest is ours.
* "liver": ours, softer than skin throughout, of the order of Okamura's bovine liver.
"""


def add_soft_tissue(
    spec: mujoco.MjSpec, layout: str, forces: TissueForces, segments: int, bits: dict[str, int]
) -> None:
    """Add skin, carriers and holds to a scene that has its needle and its thread.

    Args:
        spec: the scene.
        layout: a key of `holes.PAIRS`.
        forces: how the tissue resists.
        segments: capsules of the thread, 0 for no thread.
        bits: collision bits of what only the needle meets.
    """
    _add_skin(spec.body("phantom"), layout, forces, bits)
    for index in range(2):
        _add_carrier(spec, index)
        name = f"hold_{index}"
        _add_anchor(spec, name).add_site(name=name, size=[0.0003] * 3, group=4)
        _add_hold(spec, name, mujoco.mjtObj.mjOBJ_SITE, f"carrier_{index}", name)
    for index in range(THREAD_HOLDS if segments else 0):
        name = f"thread_hold_{index}"
        slider = _add_slider(_add_anchor(spec, name), index)
        _add_hold(spec, name, mujoco.mjtObj.mjOBJ_BODY, "thread_0", slider)
    for index in range(THREAD_HOLDS - 1 if segments else 0):
        _couple_sliders(spec, index)


def skin_name(side: str, piece: int) -> str:
    """Return the name of the skin on the flank `side` ("entry", "exit") of a piece, from 1."""
    return f"phantom_{side}{piece}_skin"


def crest_skin_name(piece: int) -> str:
    """Return the name of the needle's crest of a piece of the ridge, from 1."""
    return f"phantom_crest{piece}_skin"


def _add_skin(
    body: mujoco.MjsBody, layout: str, forces: TissueForces, bits: dict[str, int]
) -> None:
    """Cover every flank with a box, and every crest with a capsule, that only the needle meets."""
    pairs = PAIRS[layout]
    edges = phantom.piece_edges(pairs)
    contact = phantom.CONTACT | bits | {"friction": [forces.skin_friction, 0.002, 0.0001]}
    for piece, pair in enumerate(pairs, start=1):
        start, end = edges[piece - 1 : piece + 1]
        for side, hole in (("entry", pair.entry), ("exit", pair.exit)):
            along = (-phantom.flank_depth(hole), phantom.flank_height(pair, hole))
            across = (end - hole.centre[1], start - hole.centre[1])
            phantom.add_plate(body, skin_name(side, piece), hole, along, across, THICKNESS, contact)
        phantom.add_crest(body, crest_skin_name(piece), pair, start, end, bits)


def _add_carrier(spec: mujoco.MjSpec, index: int) -> None:
    """Add a point that slides along the needle's arc."""
    body = spec.body("needle").add_body(name=f"carrier_{index}")
    body.mass = CARRIER_MASS
    body.inertia = [CARRIER_MASS * 1e-5] * 3
    body.explicitinertial = True
    body.gravcomp = 1.0
    body.add_joint(
        name=f"carrier_{index}",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0.0, 0.0, -1.0],
        armature=CARRIER_ARMATURE,
        damping=CARRIER_DAMPING,
        solref_friction=FRICTION_SOLREF,
        solimp_friction=FRICTION_SOLIMP,
    )
    body.add_site(
        name=f"carrier_{index}", pos=[-needle.RADIUS, 0.0, 0.0], size=[0.0003] * 3, group=4
    )


def _add_anchor(spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Add an anchor, which is placed where something is held."""
    return spec.worldbody.add_body(name=name, mocap=True, pos=list(HIDDEN))


def _add_slider(anchor: mujoco.MjsBody, index: int) -> str:
    """Add a slider that glides along its anchor's z axis; return its name."""
    name = f"thread_slider_{index}"
    body = anchor.add_body(name=name)
    body.mass = CARRIER_MASS
    body.inertia = [CARRIER_MASS * 1e-5] * 3
    body.explicitinertial = True
    body.gravcomp = 1.0
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0.0, 0.0, 1.0],
        armature=SLIDER_ARMATURE,
        solref_friction=FRICTION_SOLREF,
        solimp_friction=FRICTION_SOLIMP,
    )
    return name


def _couple_sliders(spec: mujoco.MjSpec, index: int) -> None:
    """Add an inactive equality that makes a slider and the next one move together."""
    equality = spec.add_equality(name=f"thread_bite_{index}", type=mujoco.mjtEq.mjEQ_JOINT)
    equality.name1 = f"thread_slider_{index}"
    equality.name2 = f"thread_slider_{index + 1}"
    equality.data[:5] = [0.0, 1.0, 0.0, 0.0, 0.0]
    equality.solref = FRICTION_SOLREF
    equality.active = False


def _add_hold(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtObj, held: str, by: str) -> None:
    """Add an inactive equality that ties `held` to `by`."""
    equality = spec.add_equality(name=name, type=mujoco.mjtEq.mjEQ_CONNECT, objtype=kind)
    equality.name1 = held
    equality.name2 = by
    equality.active = False


def spring(stiffness: float, inverse_mass: float) -> Spring:
    """Return solref and solimp of a constraint that acts as a spring of `stiffness` [N/m] at rest.

    MuJoCo's force at rest is K' d² r / ((1 - d) A) with the impedance d, the reference stiffness K'
    and the inverse mass A that it uses for the pair. Here K' d is `RESPONSE`, critically damped;
    d follows from that.

    Args:
        stiffness: static stiffness [N/m].
        inverse_mass: sum of the two bodies' `body_invweight0` [1/kg].
    """
    impedance = 1.0 / (1.0 + RESPONSE / (stiffness * inverse_mass))
    reference = RESPONSE * impedance
    damping = 2.0 * math.sqrt(RESPONSE) * impedance
    return (-reference, -damping), (impedance, impedance, 0.001, 0.5, 2.0)


def graded_spring(stiffness: float, factor: float, width: float, inverse_mass: float) -> Spring:
    """Return solref and solimp of a spring whose stiffness has changed by `factor` at `width`.

    Up to a third of the width it is as requested.

    Args:
        stiffness: static stiffness near 0 [N/m].
        factor: by which it differs at `width` and beyond.
        width: [m].
        inverse_mass: as for `spring`.
    """
    _, (near, *_) = spring(stiffness, inverse_mass)
    _, (far, *_) = spring(factor * stiffness, inverse_mass)
    # MuJoCo divides solref by the far impedance; the reference stiffness must hold near 0.
    reference = RESPONSE * far**2 / near
    damping = 2.0 * math.sqrt(RESPONSE) * far
    return (-reference, -damping), (near, far, width, 0.5, LATE)


def skin_spring(stiffness: float, inverse_mass: float) -> Spring:
    """Return solref and solimp of skin, which stiffens towards its thickness.

    At its full thickness the skin is stiffer than the arms can press: only a tip that pierces it
    gets through.
    """
    return graded_spring(stiffness, STIFFENING, THICKNESS, inverse_mass)


def thread_spring(inverse_mass: float) -> Spring:
    """Return solref and solimp of a hold of the thread, which softens with the distance."""
    return graded_spring(THREAD_STIFFNESS, THREAD_SOFTENING, THREAD_REACH, inverse_mass)
