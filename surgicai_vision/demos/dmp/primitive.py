"""Primitive: dynamic movement primitives over a position and an orientation.

    primitive = fit_primitive([without_pauses(motion)])  # from one or a few demonstrations
    execution = primitive.start(position, rotation, goal_position, goal_rotation)
    while not execution.done:
        execution.advance(0.02)  # execution.position, execution.rotation

Position (Ijspeert et al., Neural Computation 25, 2013): a spring-damper pulled to the goal g, plus
a learned force,

    τ ż = α (β (g - y) - z) + f(x),   τ ẏ = z,   τ ẋ = -γ x,
    f(x) = a x Σψᵢwᵢ / Σψᵢ,   ψᵢ = exp(-hᵢ (x - cᵢ)²).

Orientation as unit quaternion (Ude et al., ICRA 2014): the error is the logarithm, the integral the
exponential,

    τ η̇ = α (β 2 log(g ∗ q̄) - η) + f(x),   τ q̇ = ½ η ∗ q.

The weights come from locally weighted regression, jointly over the demonstrations. The papers leave
the gains open; we use the usual ones: α = 25, β = α / 4 (critically damped), γ = α / 3, 80 kernels
with centres at equal times.

The amplitude a is 1 by default (Hoffmann et al., ICRA 2009): the effect of a new start or goal
decays or grows by the spring alone, and the demonstrated shape is unchanged. With `scaled` it is
the standard g - y₀, axis by axis. That needs an amplitude in every axis, which a needle that only
turns, or starts next to its goal, does not have.

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
BETA = ALPHA / 4
GAMMA = ALPHA / 3
KERNELS = 80
PAUSE_SPEED = 0.2e-3
PAUSE_TURN_RATE = math.radians(0.1)
"""A sample slower than both is a pause [m/s, rad/s] (Zhou et al., ISMR 2024)."""
MIN_SAMPLES = 5
"""Samples needed for a shape; from fewer, only the motion from start to goal is learned."""
DENSE_SAMPLES = 100
"""Fewest samples from which derivatives are taken."""
MAX_INTEGRATION_STEP = 0.05
"""Largest α dt / τ of one integration step."""
MIN_AMPLITUDE = 1e-6
"""An axis with a smaller amplitude has no shape to scale [m, rad]."""
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
    conjugated: Array = q * _CONJUGATE
    return conjugated


def log_quaternion(q: Array) -> Array:
    """Return the rotation vector 2 log q of unit quaternions, at most π long, (..., 3) [rad]."""
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    vector: Array = q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return vector


def exp_quaternion(turn: Array) -> Array:
    """Return the unit quaternion exp(turn / 2) of rotation vectors [rad], (..., 3) → (..., 4)."""
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
        InputError: shapes that do not match, numbers that are not finite, quaternions that are not
            unit.
    """

    position: Array
    rotation: Array
    dt: float

    def __post_init__(self) -> None:
        count = len(self.position)
        if count < 1 or self.position.shape != (count, 3) or self.rotation.shape != (count, 4):
            raise InputError(
                f"A motion has positions {self.position.shape} and rotations "
                f"{self.rotation.shape}; they must be (T, 3) and (T, 4), T at least 1."
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


def without_pauses(
    motion: Motion, slow: float = PAUSE_SPEED, slow_turn: float = PAUSE_TURN_RATE
) -> Motion:
    """Return `motion` without its pauses: samples slower than both limits [m/s, rad/s]."""
    steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=1)
    turns = np.linalg.norm(
        log_quaternion(multiply(motion.rotation[1:], conjugate(motion.rotation[:-1]))), axis=1
    )
    moving = (steps >= slow * motion.dt) | (turns >= slow_turn * motion.dt)
    kept = np.concatenate([[True], moving])
    return Motion(motion.position[kept], motion.rotation[kept], motion.dt)


@dataclass(frozen=True)
class Primitive:
    """A fitted primitive; duration, start and goal are chosen by `start`.

    Attributes:
        duration: mean duration of the demonstrations, τ [s].
        weights: of the force on position and on orientation, (kernels, 6).
        drift: initial velocity times τ, (6,): nonzero where a demonstration was cut out of a longer
            one.
        scaled: the force grows with the amplitude of the execution; see the module's docstring.
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
    ) -> "Execution":
        """Return an execution from a start to a goal.

        Args:
            position: of the start, (3,).
            rotation: of the start, unit quaternion (4,).
            goal_position: (3,).
            goal_rotation: unit quaternion (4,).
            duration: τ [s]; None uses the demonstrations'.

        Raises:
            InputError: a duration that is not positive.
        """
        seconds = self.duration if duration is None else duration
        if not seconds > 0.0:
            raise InputError(f"The duration is {seconds}; it must be above 0 s.")
        return Execution(self, position, rotation, goal_position, goal_rotation, seconds)

    def force(self, x: float) -> Array:
        """Return Σψᵢwᵢ / Σψᵢ · x at the phase x, (6,)."""
        psi = _kernels(np.array([x]), len(self.weights))[0]
        force: Array = psi @ self.weights * (x / psi.sum())
        return force


class Execution:
    """One execution of a primitive, integrated in time; it ends at rest at its goal.

    Attributes:
        position: present position, (3,) [m].
        rotation: present orientation, unit quaternion (4,).
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
        self.position = position.copy()
        self.rotation = rotation / np.linalg.norm(rotation)
        self.elapsed = 0.0
        self._primitive = primitive
        self._tau = tau
        self._phase = 1.0
        self._speed = primitive.drift.copy()
        self.set_goal(goal, goal_rotation)
        self._amplitude = self._error() if primitive.scaled else np.ones(6)

    @property
    def done(self) -> bool:
        """Return True once its duration has elapsed."""
        return self.elapsed >= self._tau - 1e-9

    def set_goal(self, goal: Array, goal_rotation: Array) -> None:
        """Change the goal: position (3,) and unit quaternion (4,)."""
        self._goal = goal.copy()
        self._goal_rotation = goal_rotation / np.linalg.norm(goal_rotation)

    def advance(self, dt: float) -> None:
        """Integrate over `dt` [s]."""
        substeps = max(1, math.ceil(ALPHA * dt / (self._tau * MAX_INTEGRATION_STEP)))
        substep = dt / (substeps * self._tau)
        for _ in range(substeps):
            pull = ALPHA * (BETA * self._error() - self._speed)
            push = self._amplitude * self._primitive.force(self._phase)
            self._speed += substep * (pull + push)
            self.position += substep * self._speed[:3]
            self.rotation = multiply(exp_quaternion(substep * self._speed[3:]), self.rotation)
            self._phase *= math.exp(-GAMMA * substep)
        self.rotation /= np.linalg.norm(self.rotation)
        self.elapsed += dt

    def _error(self) -> Array:
        """Return the error to the goal, (6,): translation and rotation vector."""
        turn = log_quaternion(multiply(self._goal_rotation, conjugate(self.rotation)))
        return np.concatenate([self._goal - self.position, turn])


def fit_primitive(
    motions: Sequence[Motion], kernels: int = KERNELS, scaled: bool = False
) -> Primitive:
    """Fit a primitive jointly to all demonstrations with at least `MIN_SAMPLES` samples.

    Args:
        motions: at least one.
        kernels: number of kernels, at least 2.
        scaled: see the module's docstring.

    Raises:
        InputError: no motion, or fewer than 2 kernels.
    """
    if not motions or kernels < 2:
        raise InputError(
            f"A fit needs a motion and 2 kernels or more; got {len(motions)} and {kernels}."
        )
    shaped = [motion for motion in motions if len(motion) >= MIN_SAMPLES]
    duration = float(np.mean([motion.duration for motion in shaped or motions])) or motions[0].dt
    numerator = np.zeros((kernels, 6))
    denominator = np.zeros((kernels, 6))
    drifts: list[Array] = []
    for motion in map(_dense, shaped):
        force, drift, amplitude = _forces(motion)
        drifts.append(drift)
        phase = np.exp(-GAMMA * np.linspace(0.0, 1.0, len(motion)))
        base = phase[:, None] * (
            np.where(np.abs(amplitude) > MIN_AMPLITUDE, amplitude, 0.0) if scaled else np.ones(6)
        )
        psi = _kernels(phase, kernels)
        numerator += psi.T @ (base * force)
        denominator += psi.T @ base**2
    weights = np.divide(
        numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0.0
    )
    return Primitive(duration, weights, np.mean(drifts or [np.zeros(6)], axis=0), scaled)


def _dense(motion: Motion) -> Motion:
    """Return `motion` resampled by splines to at least `DENSE_SAMPLES`, for good derivatives."""
    if len(motion) >= DENSE_SAMPLES:
        return motion
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    times = np.linspace(0.0, 1.0, len(motion))
    fine = np.linspace(0.0, 1.0, DENSE_SAMPLES)
    turning = RotationSpline(times, Rotation.from_quat(motion.rotation, scalar_first=True))
    rotation = turning(fine).as_quat(scalar_first=True)
    return Motion(
        CubicSpline(times, motion.position)(fine), rotation, motion.duration / (DENSE_SAMPLES - 1)
    )


def _forces(motion: Motion) -> tuple[Array, Array, Array]:
    """Return the force that makes the spring follow `motion`, its initial speed and its amplitude.

    Shapes are (T, 6), (6,) and (6,), in units of the motion's duration, so that demonstrations of
    different speed agree.
    """
    step = 1.0 / (len(motion) - 1)
    shifts = np.diff(motion.position, axis=0)
    turns = log_quaternion(multiply(motion.rotation[1:], conjugate(motion.rotation[:-1])))
    between = np.concatenate([shifts, turns], axis=1) / step
    # Speeds at the samples, from those halfway between: exact for a constant acceleration.
    first = 1.5 * between[:1] - 0.5 * between[1:2]
    last = 1.5 * between[-1:] - 0.5 * between[-2:-1]
    speed = np.concatenate([first, (between[1:] + between[:-1]) / 2, last])
    rate = np.gradient(speed, step, axis=0)
    left = log_quaternion(multiply(motion.rotation[-1:], conjugate(motion.rotation)))
    error = np.concatenate([motion.position[-1] - motion.position, left], axis=1)
    return rate - ALPHA * (BETA * error - speed), speed[0], error[0]


def _kernels(phase: Array, count: int) -> Array:
    """Return ψ at the phases, (T, count)."""
    centres, widths = _centres(count)
    # The limit keeps the quotient of the sums finite far beyond the last centre.
    activations: Array = np.exp(-np.minimum(widths * (phase[:, None] - centres) ** 2, 500.0))
    return activations


@functools.lru_cache(maxsize=8)
def _centres(count: int) -> tuple[Array, Array]:
    """Return centres c at equal times and widths h from the gap to the next centre, (count,) each.

    At the next centre a kernel has fallen to e⁻²: the best of the widths tried (e^-½ to e⁻⁴) at 60
    samples and more.
    """
    centres = np.exp(-GAMMA * np.linspace(0.0, 1.0, count))
    gaps = np.diff(centres)
    return centres, 2.0 / np.append(gaps, gaps[-1]) ** 2
