"""Movement: dynamic movement primitives over a position and an orientation.

    primitive = learn([filtered(motion)])                 # from one or a few demonstrations
    course = primitive.start(position, rotation, goal_position, goal_rotation)
    while not course.done:
        course.advance(0.02)                              # course.position, course.rotation

Position (Ijspeert et al., Neural Computation 25, 2013): a spring-damper pulled to the goal g and a
learned force,
    τ ż = α (β (g - y) - z) + f(x),   τ ẏ = z,   τ ẋ = -γ x,   f(x) = a x Σψᵢwᵢ / Σψᵢ,   ψᵢ =
    exp(-hᵢ (x - cᵢ)²).
Orientation as unit quaternion (Ude et al., ICRA 2014): the error is the logarithm, the integral the
exponential,
    τ η̇ = α (β 2 log(g ∗ q̄) - η) + f(x),   τ q̇ = ½ η ∗ q.
Weights by locally weighted regression, jointly over the demonstrations. The papers leave the gains
open; the usual ones are our choice: α = 25, β = α / 4 (critically damped), γ = α / 3, 80 kernels
with centres at equal times.

The amplitude a is 1 by default (Hoffmann et al., ICRA 2009): what a new start or goal adds decays
or grows like the bare spring, the demonstrated shape stays as it is. With `scaled` it is the
standard g - y₀, axis by axis, which needs an amplitude in every axis: a needle that turns on the
spot, or starts beside its goal, has none.

Quaternions are (w, x, y, z). Lengths are in metres, angles in radians, times in seconds.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core.errors import InputError

Array = NDArray[np.float64]

ALPHA = 25.0
BETA, GAMMA, KERNELS = ALPHA / 4, ALPHA / 3, 80
SLOW, SLOW_TURN = 0.2e-3, math.radians(0.1)
"""Below both speeds a sample is a pause [m/s, rad/s] (Zhou et al., ISMR 2024)."""
FEWEST = 5
"""Samples a shape needs; of fewer only the way from start to goal is learned."""
DENSE = 100
"""Samples from which derivatives are taken."""
FINE = 0.05
"""Largest α dt / τ of one integration step."""
FLAT = 1e-6
"""An axis of smaller amplitude [m, rad] has no shape to scale."""
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def multiply(a: Array, b: Array) -> Array:
    """Return the quaternion product a ∗ b, (..., 4)."""
    aw, ax, ay, az = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bw, bx, by, bz = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    product = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + bw * ax + ay * bz - az * by,
        aw * by + bw * ay + az * bx - ax * bz,
        aw * bz + bw * az + ax * by - ay * bx,
    ]
    return np.array(product) if a.ndim == b.ndim == 1 else np.stack(product, axis=-1)


def conjugate(q: Array) -> Array:
    """Return q̄, (..., 4): the inverse of a unit quaternion."""
    return q * _CONJUGATE


def turn_of(q: Array) -> Array:
    """Return the rotation vector 2 log q (..., 3) [rad] of unit quaternions, the short way: at most
    π long.
    """
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def quaternion_of(turn: Array) -> Array:
    """Return the unit quaternion exp(turn / 2), (..., 4), of rotation vectors (..., 3) [rad]."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), turn * 0.5 * np.sinc(angle / (2 * np.pi))], axis=-1)


@dataclass(frozen=True)
class Motion:
    """A demonstrated motion of T samples.

    Attributes:
        position: (T, 3) [m].
        rotation: unit quaternions, (T, 4).
        dt: time between samples [s].

    Raises:
        InputError: shapes that do not fit each other, numbers that are not finite, quaternions that
            are no units.
    """

    position: Array
    rotation: Array
    dt: float

    def __post_init__(self) -> None:
        count = len(self.position)
        if count < 1 or self.position.shape != (count, 3) or self.rotation.shape != (count, 4):
            raise InputError(
                f"A motion has positions {self.position.shape} and rotations {self.rotation.shape}; "
                "they must be (T, 3) and (T, 4), T at least 1."
            )
        norms = np.linalg.norm(self.rotation, axis=1)
        if not (
            np.isfinite(self.position).all()
            and np.allclose(norms, 1.0, atol=1e-6)
            and self.dt > 0.0
        ):
            raise InputError("A motion needs finite positions, unit quaternions and dt > 0.")

    def __len__(self) -> int:
        """Return the number of samples T."""
        return len(self.position)

    @property
    def duration(self) -> float:
        """Return the time from the first to the last sample [s]."""
        return (len(self) - 1) * self.dt


def filtered(motion: Motion, slow: float = SLOW, slow_turn: float = SLOW_TURN) -> Motion:
    """Return `motion` without its pauses: without samples slower than both limits [m/s, rad/s]."""
    steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=1)
    turns = np.linalg.norm(
        turn_of(multiply(motion.rotation[1:], conjugate(motion.rotation[:-1]))), axis=1
    )
    moves = (steps >= slow * motion.dt) | (turns >= slow_turn * motion.dt)
    kept = np.concatenate([[True], moves])
    return Motion(motion.position[kept], motion.rotation[kept], motion.dt)


@dataclass(frozen=True)
class Primitive:
    """A learned movement; time, start and goal are chosen at `start`.

    Attributes:
        duration: time it took in the demonstrations, τ [s].
        weights: of the force on position and on orientation, (kernels, 6).
        drift: initial velocity times τ, (6,): what a demonstration has that was cut out of a longer
            one.
        scaled: the force grows with the amplitude of the new movement; see the module's docstring.
    """

    duration: float
    weights: Array
    drift: Array
    scaled: bool = False

    def start(
        self,
        position: Array,
        rotation: Array,
        goal_position: Array,
        goal_rotation: Array,
        duration: float | None = None,
    ) -> "Course":
        """Return the movement from a start to a goal.

        Args:
            position: of the start, (3,).
            rotation: of the start, unit quaternion (4,).
            goal_position: (3,).
            goal_rotation: unit quaternion (4,).
            duration: τ [s]; None takes the demonstrations'.

        Raises:
            InputError: a duration that is not positive.
        """
        seconds = self.duration if duration is None else duration
        if not seconds > 0.0:
            raise InputError(f"The duration is {seconds}; it must be above 0 s.")
        return Course(self, position, rotation, goal_position, goal_rotation, seconds)

    def force(self, x: float) -> Array:
        """Return Σψᵢwᵢ / Σψᵢ · x at the phase x, (6,)."""
        psi = _kernels(np.array([x]), len(self.weights))[0]
        return psi @ self.weights * (x / psi.sum())


class Course:
    """One run of a primitive, advanced in time; it ends at rest at its goal.

    Attributes:
        position: where it is, (3,) [m].
        rotation: unit quaternion (4,).
        elapsed: time since its start [s].
    """

    def __init__(
        self,
        primitive: Primitive,
        position: Array,
        rotation: Array,
        goal: Array,
        goal_rotation: Array,
        tau: float,
    ):
        self.position, self.rotation = position.copy(), rotation / np.linalg.norm(rotation)
        self.elapsed = 0.0
        self._primitive, self._tau, self._phase = primitive, tau, 1.0
        self._speed = primitive.drift.copy()
        self.aim(goal, goal_rotation)
        self._amplitude = self._error() if primitive.scaled else np.ones(6)

    @property
    def done(self) -> bool:
        """Say whether its time is over."""
        return self.elapsed >= self._tau - 1e-9

    def aim(self, goal: Array, goal_rotation: Array) -> None:
        """Change the goal on the way: position (3,) and unit quaternion (4,)."""
        self._goal, self._goal_rotation = goal.copy(), goal_rotation / np.linalg.norm(goal_rotation)

    def advance(self, dt: float) -> None:
        """Move on by `dt` [s]."""
        parts = max(1, math.ceil(ALPHA * dt / (self._tau * FINE)))
        part = dt / (parts * self._tau)
        for _ in range(parts):
            pull = ALPHA * (BETA * self._error() - self._speed)
            push = self._amplitude * self._primitive.force(self._phase)
            self._speed += part * (pull + push)
            self.position += part * self._speed[:3]
            self.rotation = multiply(quaternion_of(part * self._speed[3:]), self.rotation)
            self._phase *= math.exp(-GAMMA * part)
        self.rotation /= np.linalg.norm(self.rotation)
        self.elapsed += dt

    def _error(self) -> Array:
        """Return the way to the goal, (6,): translation and rotation vector."""
        turn = turn_of(multiply(self._goal_rotation, conjugate(self.rotation)))
        return np.concatenate([self._goal - self.position, turn])


def learn(motions: Sequence[Motion], kernels: int = KERNELS, scaled: bool = False) -> Primitive:
    """Learn a primitive from demonstrations, jointly over all with at least `FEWEST` samples.

    Args:
        motions: at least one.
        kernels: number of kernels, at least 2.
        scaled: see the module's docstring.

    Raises:
        InputError: no motion, or fewer than 2 kernels.
    """
    if not motions or kernels < 2:
        raise InputError(
            f"Learning needs a motion and 2 kernels or more; got {len(motions)} and {kernels}."
        )
    shaped = [motion for motion in motions if len(motion) >= FEWEST]
    duration = float(np.mean([motion.duration for motion in shaped or motions])) or motions[0].dt
    above, below = np.zeros((kernels, 6)), np.zeros((kernels, 6))
    drifts: list[Array] = []
    for motion in map(_dense, shaped):
        force, drift, amplitude = _forces(motion)
        drifts.append(drift)
        phase = np.exp(-GAMMA * np.linspace(0.0, 1.0, len(motion)))
        base = phase[:, None] * (
            np.where(np.abs(amplitude) > FLAT, amplitude, 0.0) if scaled else np.ones(6)
        )
        psi = _kernels(phase, kernels)
        above += psi.T @ (base * force)
        below += psi.T @ base**2
    weights = np.divide(above, below, out=np.zeros_like(above), where=below > 0.0)
    return Primitive(duration, weights, np.mean(drifts or [np.zeros(6)], axis=0), scaled)


def _dense(motion: Motion) -> Motion:
    """Return `motion` with at least `DENSE` samples, by splines: a few samples make poor
    derivatives.
    """
    if len(motion) >= DENSE:
        return motion
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    times, fine = np.linspace(0.0, 1.0, len(motion)), np.linspace(0.0, 1.0, DENSE)
    turning = RotationSpline(times, Rotation.from_quat(motion.rotation, scalar_first=True))
    rotation = turning(fine).as_quat(scalar_first=True)
    return Motion(
        CubicSpline(times, motion.position)(fine), rotation, motion.duration / (DENSE - 1)
    )


def _forces(motion: Motion) -> tuple[Array, Array, Array]:
    """Return the force (T, 6) that makes the spring follow `motion`, its initial speed (6,) and
    amplitude (6,).

    In units of its duration, so that demonstrations of different speed agree.
    """
    step = 1.0 / (len(motion) - 1)
    ways = np.diff(motion.position, axis=0)
    turns = turn_of(multiply(motion.rotation[1:], conjugate(motion.rotation[:-1])))
    between = np.concatenate([ways, turns], axis=1) / step
    # Speeds at the samples, from those half-way between: exact for a constant acceleration.
    first, last = 1.5 * between[:1] - 0.5 * between[1:2], 1.5 * between[-1:] - 0.5 * between[-2:-1]
    speed = np.concatenate([first, (between[1:] + between[:-1]) / 2, last])
    rate = np.gradient(speed, step, axis=0)
    left = turn_of(multiply(motion.rotation[-1:], conjugate(motion.rotation)))
    error = np.concatenate([motion.position[-1] - motion.position, left], axis=1)
    return rate - ALPHA * (BETA * error - speed), speed[0], error[0]


def _kernels(phase: Array, count: int) -> Array:
    """Return ψ at the phases, (T, count)."""
    centres, widths = _centres(count)
    # The floor keeps the quotient of the sums alive far behind the last centre.
    return np.exp(-np.minimum(widths * (phase[:, None] - centres) ** 2, 500.0))


@functools.lru_cache(maxsize=8)
def _centres(count: int) -> tuple[Array, Array]:
    """Return centres c at equal times and widths h by the way to the next centre, (count,) each.

    At the next centre a kernel has fallen to e⁻²: of the widths tried (e^-½ to e⁻⁴) the best at 60
    samples and more.
    """
    centres = np.exp(-GAMMA * np.linspace(0.0, 1.0, count))
    gaps = np.diff(centres)
    return centres, 2.0 / np.append(gaps, gaps[-1]) ** 2
