"""Resampling: a bag's arms and needle at the control rate and in our frames.

    arrays = read_sandboxed(path, "bag", topics=config.all_topics)
    recording = resample(arrays, config, instrument)

Each topic has its own times, with jitter and lost messages. Its times are those of the headers if
it has headers (shifted by the median delay, so that they agree with topics without headers),
otherwise those of reception. Positions, joints and jaws are interpolated linearly between the two
messages around a sample, rotations by slerp. Labels and commands (a jaw from `servo_jp`) hold until
the next message. A sample between two messages further apart than `max_gap` is not `valid`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.imports.rosbag.config import BagConfig, printable, topic_list
from surgicai_vision.demos.imports.rosbag.messages import AMBF
from surgicai_vision.scene import kinematics

RATE = float(names.FPS)
"""Samples per second: the control rate."""
MAX_DURATION = 3600.0
"""Longest recording that is resampled [s]."""
AMBF_UNIT = 0.1
"""Metres per unit of length of the challenge's AMBF scenes (its `SimToSI`)."""
COMMANDS = ("servo_jp", "move_jp")
"""Last parts of the CRTK topics that command joints."""
ENDOSCOPE_FRAMES = ("ecm", "cam")
"""Parts of the names of frames that are relative to the endoscope, not an arm's base."""

Arrays = Mapping[str, NDArray[np.generic]]


class NothingShown(InputError):
    """A recording that does not show what is requested; others of the same import may show it."""


@dataclass(frozen=True)
class Arm:
    """One arm's motion.

    Attributes:
        tip: T_base_tip, (N, 4, 4).
        jaw: one finger's angle, (N,) [rad], or None where it was not recorded.
    """

    tip: NDArray[np.float64]
    jaw: NDArray[np.float64] | None


@dataclass(frozen=True)
class Recording:
    """N samples at `RATE`.

    Attributes:
        arms: arm → its motion; arms that were not recorded are missing.
        needle: T_world_needle (N, 4, 4), or None.
        label: present label, (N,) texts, "" before the first; or None.
        valid: (N,) bool; False in a gap of any topic except labels and commands.
        time: recorded time since the first sample, (N,) [s].
        topics: every topic of the bag with its type, for error messages.
    """

    arms: Mapping[str, Arm]
    needle: NDArray[np.float64] | None
    label: NDArray[np.str_] | None
    valid: NDArray[np.bool_]
    time: NDArray[np.float64]
    topics: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of samples N."""
        return len(self.valid)


def resample(arrays: Arrays, config: BagConfig, instrument: str) -> Recording:
    """Return what was read from a bag, at the control rate.

    Args:
        arrays: see `reader.read`.
        config: how to read the bag.
        instrument: the instrument that the joints belong to, where there are joints and no pose.

    Raises:
        NothingShown: there is no time in which all topics overlap.
        InputError: no arm, a recording that is too long, poses in a frame that is not the arm's
            base.
    """
    times = _times(arrays, config)
    roles = _roles(arrays, config)
    steady = [role for role in roles if not _is_command(role, config)]
    begin = max(times[role].min() for role in steady)
    end = min(times[role].max() for role in steady)
    overlap = (
        f"The topics overlap for {(end - begin) / 1e9:.1f} s; that must be above 0 and at most "
        f"{MAX_DURATION:.0f} s."
    )
    if not begin < end:
        raise NothingShown(overlap)
    if end > begin + MAX_DURATION * 1e9 * config.speed:
        raise InputError(overlap)
    step = 1e9 / RATE * config.speed
    grid = np.arange(0.0, (end - begin) + 1e-6 * step, step)
    values = {role: arrays[f"{role}.value"].astype(np.float64, copy=False) for role in roles}
    tracks = {role: _distinct(times[role], values[role], begin) for role in roles}
    valid = np.ones(len(grid), bool)
    for role in steady:
        valid &= _covered(tracks[role][0], grid, config.max_gap * 1e9)
    arms: dict[str, Arm] = {}
    for role in roles:
        arm, _, kind = role.partition("_")
        if kind in ("pose", "joints"):
            jaw = _jaw(f"{arm}_jaw", tracks, grid, config)
            arms[arm] = Arm(_tip(role, tracks[role], grid, arrays, config, instrument), jaw)
    needle = _needle(tracks["needle"], grid, arrays, config) if "needle" in tracks else None
    label = None
    if "label.value" in arrays:
        labels = _distinct(times["label"], arrays["label.value"], begin)
        label = np.where(labels[0][0] <= grid, _last(labels, grid), "")
    return Recording(arms, needle, label, valid, grid / 1e9, tuple(map(str, arrays["topics"])))


def _is_command(role: str, config: BagConfig) -> bool:
    """Return True if a role's topic carries commands, which hold until the next one."""
    return role.endswith("_jaw") and config.all_topics[role].rsplit("/", 1)[-1] in COMMANDS


def _last[T: np.generic](
    track: tuple[NDArray[np.float64], NDArray[T]], grid: NDArray[np.float64]
) -> NDArray[T]:
    """Return the latest value at each sample; before the first value, the first one."""
    times, values = track
    held: NDArray[T] = values[np.maximum(np.searchsorted(times, grid, side="right") - 1, 0)]
    return held


def _jaw(
    role: str, tracks: Mapping[str, "Track"], grid: NDArray[np.float64], config: BagConfig
) -> NDArray[np.float64] | None:
    """Return one finger's angle (N,) [rad]; None where it was not recorded."""
    if role not in tracks:
        return None
    return config.jaw * (
        _last(tracks[role], grid) if _is_command(role, config) else np.interp(grid, *tracks[role])
    )


def _roles(arrays: Arrays, config: BagConfig) -> list[str]:
    """Return the roles to interpolate: each arm's pose, or else joints, its jaw, and the needle."""
    roles: list[str] = []
    for arm in names.ARMS:
        recorded = [
            role
            for role in (f"{arm}_pose", f"{arm}_joints", f"{arm}_jaw")
            if f"{role}.value" in arrays
        ]
        if f"{arm}_pose" in recorded:
            roles += [role for role in recorded if role != f"{arm}_joints"]
        elif f"{arm}_joints" in recorded:
            roles += recorded
    if not roles:
        wanted = ", ".join(config.all_topics[f"{arm}_pose"] for arm in names.ARMS)
        there = topic_list(arrays["topics"].tolist(), wanted)
        raise InputError(
            f"The recording has no arm's pose: it has none of {wanted}. The topics are {there}."
        )
    return [*roles, "needle"] if "needle.value" in arrays else roles


def _times(arrays: Arrays, config: BagConfig) -> dict[str, NDArray[np.int64]]:
    """Return each role's times [ns], int64, on one clock."""
    roles = [key.removesuffix(".time") for key in arrays if key.endswith(".time")]
    times = {role: arrays[f"{role}.time"].astype(np.int64, copy=False) for role in roles}
    stamps = {role: arrays[f"{role}.stamp"].astype(np.int64, copy=False) for role in roles}
    stamped = [role for role in roles if (stamps[role] > 0).all()]
    if config.clock == "bag" or (config.clock == "auto" and not stamped):
        return times
    if not stamped:
        raise InputError("clock is 'stamp', but the messages have no stamps; use 'bag' or 'auto'.")
    late = np.concatenate([times[role] - stamps[role] for role in stamped])
    shift = int(np.median(late))
    return {**times, **{role: stamps[role] + shift for role in stamped}}


def _distinct[T: np.generic](
    times: NDArray[np.int64], values: NDArray[T], begin: int
) -> tuple[NDArray[np.float64], NDArray[T]]:
    """Return increasing times since `begin` [ns] and their values; of a repeated time, the last."""
    order = np.argsort(times, kind="stable")
    since = (times[order] - begin).astype(np.float64)
    last = np.append(np.diff(since) > 0, True)
    return since[last], values[order][last]


def _covered(
    times: NDArray[np.float64], grid: NDArray[np.float64], gap: float
) -> NDArray[np.bool_]:
    """Return for each sample whether the messages around it are at most `gap` [ns] apart."""
    after = np.clip(np.searchsorted(times, grid, side="left"), 0, len(times) - 1)
    before = np.clip(np.searchsorted(times, grid, side="right") - 1, 0, len(times) - 1)
    return times[after] - times[before] <= gap


def resampled(
    times: NDArray[np.float64], poses: NDArray[np.float64], grid: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return poses (M, 7), x y z and quaternion w x y z, at new times as matrices (N, 4, 4)."""
    found = np.tile(np.eye(4), (len(grid), 1, 1))
    for axis in range(3):
        found[:, axis, 3] = np.interp(grid, times, poses[:, axis])
    turns = Rotation.from_quat(poses[:, 3:], scalar_first=True)
    inside = np.clip(grid, times[0], times[-1])
    found[:, :3, :3] = (
        Slerp(times, turns)(inside) if len(times) > 1 else turns[[0] * len(grid)]
    ).as_matrix()
    return found


def as_matrix(pose: tuple[float, ...]) -> NDArray[np.float64]:
    """Return x y z [m] and a quaternion w x y z as a pose (4, 4); the identity for ()."""
    return (
        resampled(np.zeros(1), np.array([pose], dtype=float), np.zeros(1))[0] if pose else np.eye(4)
    )


Track = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Times [ns] and values."""


def _tip(
    role: str,
    track: Track,
    grid: NDArray[np.float64],
    arrays: Arrays,
    config: BagConfig,
    instrument: str,
) -> NDArray[np.float64]:
    """Return an arm's T_base_tip (N, 4, 4) from its poses or its joints."""
    arm, kind = role.split("_")
    times, values = track
    if kind == "joints":
        joints = np.column_stack([np.interp(grid, times, np.unwrap(column)) for column in values.T])
        unit = AMBF_UNIT if str(arrays[f"{role}.type"]) in AMBF else config.length_scale
        joints[:, kinematics.INSERTION] *= unit
        return np.stack([kinematics.forward(row, instrument) for row in joints])
    placed = {names.PSM1: config.frames.psm1, names.PSM2: config.frames.psm2}[arm]
    frame = str(arrays[f"{role}.frame"]).lower()
    if not placed and any(part in frame for part in ENDOSCOPE_FRAMES):
        raise InputError(
            f"{config.all_topics[role]} is in frame '{printable(frame)}', not in {arm}'s base. "
            f"Use a topic that is in the base (dVRK: /{arm.upper()}/local/measured_cp), or give "
            f"the frame's pose in the base as frames: {arm}."
        )
    scaled = values * np.array([config.length_scale] * 3 + [1.0] * 4)
    return (
        as_matrix(placed)
        @ resampled(times, scaled, grid)
        @ np.linalg.inv(as_matrix(config.frames.tip))
    )


def _needle(
    track: Track, grid: NDArray[np.float64], arrays: Arrays, config: BagConfig
) -> NDArray[np.float64]:
    """Return T_world_needle (N, 4, 4)."""
    scale = config.needle_scale or (AMBF_UNIT if str(arrays["needle.type"]) in AMBF else 1.0)
    poses = resampled(track[0], track[1] * np.array([scale] * 3 + [1.0] * 4), grid)
    return (
        as_matrix(config.frames.needle)
        @ poses
        @ np.linalg.inv(as_matrix(config.frames.needle_offset))
    )
