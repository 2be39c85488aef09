"""Configuration: frozen dataclasses, the only schema. Built at the edge, saved with every result.

`from_mapping` builds a dataclass from plain data (YAML, JSON) and refuses unknown keys with the
nearest name; `to_mapping` is its inverse; `digest` hashes the canonical JSON. Nothing here is
instantiated by a name found in a file.
"""

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar, cast

import yaml

from surgicai_vision.core import names
from surgicai_vision.core.errors import (
    InputError,
    UnknownName,
    check_at_least,
    check_at_most,
    check_name,
    check_positive,
    shown,
)
from surgicai_vision.core.tasks import SUBTASK_STEPS, check_task, task_steps
from surgicai_vision.core.yaml_text import load_yaml

if TYPE_CHECKING:
    import numpy as np
    from _typeshed import DataclassInstance
    from numpy.typing import NDArray

T = TypeVar("T")

type JSON = bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None
"""What JSON can hold."""

STEPS: Mapping[str, tuple[float, float, float]] = types.MappingProxyType(
    {"paper": (0.5e-3, 2.0, 0.05), "released": (1.0e-3, 3.0, 0.05), "shipped": (1.5e-3, 3.0, 0.05)}
)
"""Step preset → translation [m], rotation [deg], jaw [rad] of an action of 1. Sources:
SurgicAI's image evaluation, its RL training script, the trajectories shipped with its release."""

ADVANCES = ("success", "told")
"""What moves the whole procedure to its next subtask: the measured success, or whoever acts."""
DWELL = 15
"""Control steps for which a subtask's success must hold in a whole procedure before the next."""
CLOCK_PERIOD = 25
"""Period of the sine and cosine of `clock` [control steps]."""
SECOND_ATTEMPT_STEP = 100
"""Control step at which the second attempt of a search begins (`demos.search_expert`), since the
expert's own grasp takes 70 to 85; another one follows every `CLOCK_PERIOD`."""
CLOCK_SIZE = 3
"""Length of what `clock` returns."""
LARGEST_INTEGER = 2**63 - 1
"""Largest integer of a configuration, as in a table's column; the smallest is its negative."""
LATER: Mapping[str, bool] = types.MappingProxyType({"later": True})
"""Metadata of a field that was added to its dataclass later (`to_identity`)."""


@dataclass(frozen=True)
class SceneConfig:
    """What the scene consists of; its digest with the geometry's version is the scene hash.

    Attributes:
        layout: phantom layout, one of `names.LAYOUTS`.
        hole_pair: 1..4, the pair of holes the stitch goes through.
        thread: number of thread segments, 0 for none.
        instrument: PSM instrument, "400006" (Large Needle Driver of SurgicAI) or "420006".
        grasp: "friction" (contact forces only) or "attach" (a weld, the released code's rule).
        torque: limits of the arms' servos, a key of `scene.arm.TORQUES`: "effective" (about 10 N at
            the tip) or "dvrk" (what its motors can give).
        tissue: "channels" (rigid, with open holes, SurgicAI's) or "soft" (pierced anywhere).
        tissue_forces: how soft tissue resists: "phantom", "skin" or "liver".
        ink: which openings of channels are ringed with ink: all "alike" (SurgicAI's), or only the
            pair that is "due", so that images show which of several is to be sewn. Soft tissue
            always marks that pair, and takes no other ink.
    """

    layout: str = "simple"
    hole_pair: int = 1
    thread: int = 0
    instrument: str = "400006"
    grasp: str = "friction"
    torque: str = "effective"
    tissue: str = "channels"
    tissue_forces: str = "phantom"
    ink: str = field(default="alike", metadata=LATER)

    def __post_init__(self) -> None:
        check_name("layout", self.layout, names.LAYOUTS)
        check_name("grasp level", self.grasp, names.GRASPS)
        check_name("instrument", self.instrument, ("400006", "420006"))
        check_name("torque preset", self.torque, names.TORQUES)
        check_name("tissue", self.tissue, names.TISSUES)
        check_name("tissue forces", self.tissue_forces, names.TISSUE_FORCES)
        check_name("ink", self.ink, names.INKS)
        if self.ink != "alike" and self.tissue != "channels":
            raise InputError(
                f"ink is {self.ink!r} in {self.tissue} tissue, which always marks the pair to be "
                "sewn; leave it out."
            )
        if self.hole_pair not in (1, 2, 3, 4):
            raise InputError(f"hole_pair is {self.hole_pair!r}; allowed: 1, 2, 3, 4.")
        if self.thread not in (0, 10, 20, 40):
            raise InputError(f"thread is {self.thread!r} segments; allowed: 0, 10, 20, 40.")


@dataclass(frozen=True)
class SuccessRule:
    """What a subtask's success requires in learning beyond the paper's; by default nothing.

    Attributes:
        steps: control steps for which it must hold; the whole procedure has `DWELL`.
        tolerance_share: share of the tolerance within which it counts. A policy that stops at the
            edge has no margin for a start that it never saw.
        keeps_holes: it counts only while the needle has passed as many holes as at the start. The
            paper's handoff also counts with the needle torn out of the tissue, after which no
            pullout can succeed.
    """

    steps: int = 1
    tolerance_share: float = 1.0
    keeps_holes: bool = False

    def __post_init__(self) -> None:
        check_positive(success_steps=self.steps, tolerance_share=self.tolerance_share)
        if self.tolerance_share > 1:
            raise InputError(f"tolerance_share is {self.tolerance_share}; it must be at most 1.")


ACTION_REPEAT_LIMIT = 10
"""Longest time an action may be held [control steps]: 0.2 s. The expert, held for 2, still succeeds
in grasp, insert and handoff; held for 4 it fails in two of them."""
WIDEST = 65_536
"""Maximum units of a hidden layer; the bundled policies have 256."""
LATENCY_LIMIT = 5
"""Longest latency [control steps]: 100 ms."""
RANDOMISATION_LIMITS: Mapping[str, float] = types.MappingProxyType(
    {
        "light": 0.9,
        "colour": 0.9,
        "camera_shift": 20.0,
        "camera_turn": 20.0,
        "camera_fovy": 15.0,
        "needle_thickness": 0.3,
        "friction": 0.5,
        "phantom_shift": 10.0,
        "kinematic_error": 1.0,
        "needle_size": 0.2,
        "latency": LATENCY_LIMIT,
        "phantom_turn": 15.0,
        "robot_start": 15.0,
        "distractors": 5,
        "appearance_shift": 1.0,
    }
)
"""Axis → largest magnitude: beyond it the scene is out of view or the procedure impossible."""
ANY = "any"
"""A choice: each episode draws one of all values."""
NEEDLE_ARCS = ("1/3", "3/8", "1/2")
"""Arcs of surgical needles, as parts of a circle; the scene's own is the first."""
CHOSEN_ARCS: Mapping[str, tuple[str, ...]] = types.MappingProxyType(
    {
        "": NEEDLE_ARCS[:1],
        ANY: NEEDLE_ARCS,
        names.TRAIN: ("1/3", "1/2"),
        names.HELDOUT: ("3/8",),
        **{arc: (arc,) for arc in NEEDLE_ARCS},
    }
)
"""Value of `needle_arc` → the arcs that it may draw; the held-out arc lies between those for
training."""
RANDOMISATION_CHOICES: Mapping[str, tuple[str, ...]] = types.MappingProxyType(
    {
        "pair": ("", ANY),
        "needle_arc": tuple(CHOSEN_ARCS),
        "appearance": ("", *names.APPEARANCE_SETS, *names.APPEARANCES),
    }
)
"""Axis that is a choice → its possible values; "" is off."""


def check_hidden(hidden: Sequence[int]) -> None:
    """Refuse widths of hidden layers that no network of ours may have.

    Raises:
        InputError: no layer, an empty one, or one wider than `WIDEST`.
    """
    if not hidden or min(hidden) < 1:
        raise InputError(f"hidden is {hidden}; give at least one layer of width 1 or more.")
    check_at_most(WIDEST, **{"the widest layer of hidden": max(hidden)})


@dataclass(frozen=True)
class RandomisationConfig:
    """Domain randomisation: each axis is drawn uniformly from ± its value for every episode.

    The default of every axis is 0 or "", which is off. Combinations that geometry forbids are
    refused when an env is made (`envs.feasibility`).

    Attributes:
        light: brightness of each light, as a fraction of it.
        colour: tint of the tissue and of what surrounds it, as a fraction of each colour channel.
        camera_shift: position of each camera along each axis [mm]; the endoscope's two move as one.
        camera_turn: rotation of each camera about each axis [deg].
        camera_fovy: vertical field of view of each camera [deg].
        needle_thickness: fraction of the needle's thickness.
        needle_size: fraction of the radius of the needle's arc, and so of its length.
        friction: fraction of every friction coefficient.
        phantom_shift: position of the phantom, its holes and goals, in x and y [mm]; a needle that
            lies on it moves with it.
        kinematic_error: offset of each arm's first three joints, unknown to the arm; 1 is
            ±5°, ±5°, ±5 mm, the joint errors of the surgical robotics challenge.
        latency: an action takes effect this many control steps later; the same in every episode.
        phantom_turn: rotation of the phantom about world z [deg]; see `envs.placement` for the
            axis.
        robot_start: position of each arm's tip at the start, along each axis of the world [mm].
        pair: "any" draws the pair of holes to be sewn from all four; "" takes the scene's.
        needle_arc: how much of a circle the needle is: one of `NEEDLE_ARCS`, or "any" of them;
            "train" draws one to train on, a third (in two of three episodes) or a half, "heldout"
            the one that is kept for tests; "" takes the scene's, a third.
        appearance: "train" draws one of the five families of looks for training, "varied" one of
            the same with random surroundings, "random" one of these or the same with random tissue,
            instruments and light as well, "heldout" one of those kept for tests, a family's name
            takes that one; within it every episode has its own look. "" takes the plain look. See
            docs/looks.md.
        distractors: largest number of distractor objects, 0 to 5: a second needle, gauze, a clip,
            cut thread, blood. Each episode draws how many. They are visual only.
        appearance_shift: how far each episode's look is shifted towards one of a held-out family,
            0 to 1; for tests only.
    """

    light: float = 0.0
    colour: float = 0.0
    camera_shift: float = 0.0
    camera_turn: float = 0.0
    camera_fovy: float = 0.0
    needle_thickness: float = 0.0
    friction: float = 0.0
    phantom_shift: float = 0.0
    kinematic_error: float = 0.0
    needle_size: float = 0.0
    latency: int = 0
    phantom_turn: float = 0.0
    robot_start: float = 0.0
    pair: str = ""
    needle_arc: str = ""
    appearance: str = ""
    distractors: int = 0
    appearance_shift: float = 0.0

    def __post_init__(self) -> None:
        for axis, limit in RANDOMISATION_LIMITS.items():
            if not 0 <= getattr(self, axis) <= limit:
                raise InputError(
                    f"randomisation: {axis} is {getattr(self, axis)}; allowed: 0 to {limit}."
                )
        for axis, choices in RANDOMISATION_CHOICES.items():
            check_name(f"randomisation: {axis}", getattr(self, axis), choices)

    @property
    def on(self) -> tuple[str, ...]:
        """Return the axes that are not 0 or empty."""
        axes = (*RANDOMISATION_LIMITS, *RANDOMISATION_CHOICES)
        return tuple(axis for axis in axes if getattr(self, axis))

    @property
    def text(self) -> str:
        """What varies, in words: each axis that is on, with its value; empty where none is."""
        return ", ".join(f"{axis} {vars(self)[axis]}" for axis in self.on)

    @property
    def arcs(self) -> tuple[str, ...]:
        """The arcs that the needle may have."""
        return CHOSEN_ARCS[self.needle_arc]

    @property
    def shows_heldout(self) -> bool:
        """Return True if episodes may look as one of the held-out families."""
        return bool(
            self.appearance in (names.HELDOUT, *names.HELDOUT_APPEARANCES) or self.appearance_shift
        )


WORLD = RandomisationConfig(
    phantom_shift=10.0,
    phantom_turn=15.0,
    pair=ANY,
    needle_size=0.16,
    needle_arc=ANY,
    needle_thickness=0.3,
    robot_start=15.0,
)
"""A world that varies: every geometric axis at its limit. The needle's size is the largest that
leaves room for PSM2's jaws in every hole pair, with a needle of a third of a circle."""


@dataclass(frozen=True)
class TaskConfig:
    """One task in one scene: everything that defines an episode.

    Attributes:
        task: one of `tasks.task_names()`.
        scene: the scene.
        step: step-size preset, a key of `STEPS`.
        tolerance: "paper" or "released" success tolerances.
        reward: "sparse" (0 on success, else -1), "dense" or "staged" (`envs.base`).
        max_steps: episode limit [control steps]; 0 takes the task's own: the paper's 200 per
            subtask, 1,000 for the five in a row.
        randomisation: what differs from episode to episode besides the start; nothing by default.
        action_repeat: control steps that an action is held; the reward is that of the last one.
        hold_jaw: take the jaw's action as 0, as the released code does in an insertion, in any
            subtask that starts with the needle held.
        end_on_drop: in a subtask that starts with the needle held, end the episode if it drops.
        advance: how the whole procedure moves to its next subtask: "success", once the present
            one's measured success has held for `DWELL` steps, as in the released code, or "told",
            only by `enter`, so that nothing the env measures decides which arm moves or lets go.
            A task of one subtask is the same either way.
    """

    task: str = "grasp"
    scene: SceneConfig = field(default_factory=SceneConfig)
    step: str = "paper"
    tolerance: str = "paper"
    reward: str = "sparse"
    max_steps: int = 0
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)
    action_repeat: int = 1
    hold_jaw: bool = False
    end_on_drop: bool = False
    advance: str = "success"

    def __post_init__(self) -> None:
        check_task(self.task)
        check_name("step preset", self.step, STEPS)
        check_name("tolerance preset", self.tolerance, ("paper", "released"))
        check_name("reward", self.reward, names.REWARDS)
        if not 1 <= self.action_repeat <= ACTION_REPEAT_LIMIT:
            raise InputError(
                f"action_repeat is {self.action_repeat}; allowed: 1 to {ACTION_REPEAT_LIMIT}."
            )
        check_name("advance", self.advance, ADVANCES)
        if self.max_steps < 0:
            raise InputError(
                f"max_steps is {self.max_steps}; it must be at least 1, or 0 for the paper's limit."
            )
        if self.max_steps == 0:
            object.__setattr__(self, "max_steps", task_steps(self.task))

    @property
    def steps_per_second(self) -> int:
        """Steps of simulated time per second, each with an action of its own, rounded down."""
        return names.FPS // self.action_repeat


def world_text(env: TaskConfig) -> str:
    """Return what is unusual in the world of an env: in its scene, and what varies.

    Each field is given with its value; "" is the usual scene in which nothing varies.
    """
    usual = SceneConfig()
    scene = [
        f"{each.name} {getattr(env.scene, each.name)}"
        for each in dataclasses.fields(usual)
        if getattr(env.scene, each.name) != getattr(usual, each.name)
    ]
    return ", ".join(filter(None, [*scene, env.randomisation.text]))


def from_mapping(cls: type[T], mapping: Mapping[str, object], where: str = "configuration") -> T:
    """Build the dataclass `cls` from plain data, nested dataclasses included.

    Raises:
        UnknownName: a key that `cls` does not have.
        InputError: a value of the wrong type, or one that has no default and is missing.
    """
    if not isinstance(mapping, Mapping):
        raise InputError(f"{where}: expected a table of keys, got {type(mapping).__name__}.")
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    types_by_name = typing.get_type_hints(cls)
    hints = {field.name: types_by_name[field.name] for field in fields}
    values = {}
    for key, value in mapping.items():
        if key not in hints:
            raise UnknownName(f"key in {where}", key, hints)
        values[key] = convert(hints[key], value, f"{where}: {key}")
    nothing = dataclasses.MISSING
    for item in fields:
        if item.name not in values and item.default is nothing and item.default_factory is nothing:
            raise InputError(f"{where}: '{item.name}' is missing.")
    return cls(**values)


def convert(hint: object, value: object, where: str) -> object:
    """Return `value` as the type `hint` says, or raise `InputError`."""
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_to_one(arguments, value, where)
    if origin is typing.Literal:
        if value not in arguments:
            allowed = ", ".join(map(repr, arguments))
            raise InputError(f"{where}: {shown(value)} is unknown; allowed: {allowed}.")
        return value
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_mapping(hint, cast(Mapping[str, object], value), where)
    if origin in (tuple, list):
        if not isinstance(value, list | tuple):
            raise InputError(f"{where}: expected a list, got {shown(value)}.")
        hints = arguments
        if origin is list or Ellipsis in arguments:
            hints = arguments[:1] * len(value)
        if len(value) != len(hints):
            raise InputError(f"{where}: expected {len(hints)} values, got {len(value)}.")
        return origin(convert(of, item, where) for of, item in zip(hints, value, strict=True))
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            raise InputError(f"{where}: expected a table of keys, got {shown(value)}.")
        for key in value:
            if not isinstance(key, str):
                raise InputError(f"{where}: the key {shown(key)} is not text; put it in quotes.")
        return value
    if isinstance(value, int) and not -LARGEST_INTEGER <= value <= LARGEST_INTEGER:
        raise InputError(
            f"{where}: the integer {shown(value)} is too large; give one of at most 18 digits."
        )
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and (
        not isinstance(value, hint) or (hint is int and isinstance(value, bool))
    ):
        raise InputError(f"{where}: expected {hint.__name__}, got {shown(value)}.")
    return value


def _convert_to_one(hints: Sequence[object], value: object, where: str) -> object:
    """Return `value` as the first of several types that it fits; see `convert`."""
    if value is None and type(None) in hints:
        return None
    *others, last = (hint for hint in hints if hint is not type(None))
    for hint in others:
        with suppress(InputError):
            return convert(hint, value, where)
    return convert(last, value, where)


def to_mapping(config: "DataclassInstance") -> dict[str, JSON]:
    """Return a frozen dataclass as plain JSON data."""
    plain: dict[str, JSON] = json.loads(json.dumps(dataclasses.asdict(config)))
    return plain


def to_identity(config: "DataclassInstance") -> dict[str, JSON]:
    """Return a frozen dataclass as the plain data that identifies it.

    As `to_mapping`, but without the fields, nested ones included, that are marked `LATER` and have
    their default: the digest of a configuration that does not use them stays the same.
    """
    plain = to_mapping(config)
    for each in dataclasses.fields(config):
        value = getattr(config, each.name)
        if each.metadata == LATER and value == each.default:
            del plain[each.name]
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            plain[each.name] = to_identity(value)
    return plain


def read_changes(texts: Iterable[str]) -> dict[str, JSON]:
    """Read `clock=false`, `epochs=10` as keys and their YAML values.

    Raises:
        InputError: a text of another form, or a key given twice.
    """
    changes: dict[str, JSON] = {}
    for text in texts:
        key, sign, value = text.partition("=")
        if not sign or not key or key in changes:
            raise InputError(
                f"change '{text}' is not understood; give KEY=VALUE, each key once, "
                "such as clock=false."
            )
        try:
            changes[key] = cast(JSON, load_yaml(value))
        except (yaml.YAMLError, ValueError, RecursionError):  # a date that does not exist, …
            raise InputError(f"change '{key}': {shown(value)} is not a YAML value.") from None
    return changes


def digest(value: object) -> str:
    """Return the sha256 (hex) of the canonical JSON of a dataclass or of plain data."""
    plain = (
        dataclasses.asdict(value)
        if dataclasses.is_dataclass(value) and not isinstance(value, type)
        else value
    )
    return hashlib.sha256(
        json.dumps(plain, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def check_frame_stride(frame_stride: int) -> None:
    """Raise `InputError` unless `frame_stride` divides the frames per second."""
    if frame_stride < 1 or names.FPS % frame_stride:
        allowed = ", ".join(
            str(number) for number in range(1, names.FPS + 1) if names.FPS % number == 0
        )
        raise InputError(
            f"frame_stride is {frame_stride}; it must divide the {names.FPS} frames per second: "
            f"{allowed}."
        )


def clock(steps: "NDArray[np.int64] | NDArray[np.float64]") -> "NDArray[np.float32]":
    """Encode the control steps (N,) since a subtask began for a policy, as (N, 3) float32.

    The values are the share of `SUBTASK_STEPS`, and the sine and cosine of a hand that turns once
    in `CLOCK_PERIOD` steps: the share alone changes too little in a few steps to act on.
    """
    import numpy as np  # not at the top: `--help` imports this module and must be quick

    turn = 2.0 * np.pi * steps / CLOCK_PERIOD
    return np.stack([steps / SUBTASK_STEPS, np.sin(turn), np.cos(turn)], axis=1).astype(np.float32)


@dataclass(frozen=True)
class Pace:
    """How fast a policy acts: four shares, each above 0 and at most 1, and when it tries again.

    Where actions take effect late, a policy at full speed swings about its goal, its jaws swing
    open and closed, and its clock says that it is there before it is (docs/evaluation.md).

    Attributes:
        speed: share of each action that is executed; the clock runs as much slower.
        jaw_speed: share of the jaw's motion that is executed besides.
        pinch_speed: share of the jaw's motion that is executed besides where it shuts nearly closed
            jaws (`evaluation.pace`).
        clock_speed: how much slower the clock runs besides.
        retry_after: control steps with shut jaws after which the clock of a policy that has learned
            a search goes on to the next attempt (`evaluation.policy_clock`); 0: it waits for it.
    """

    speed: float = 1.0
    jaw_speed: float = 1.0
    pinch_speed: float = 1.0
    clock_speed: float = 1.0
    retry_after: int = 0

    def __post_init__(self) -> None:
        for key in ("speed", "jaw_speed", "pinch_speed", "clock_speed"):
            share = getattr(self, key)
            if not 0 < share <= 1:
                raise InputError(f"{key} is {share}; give a share above 0, at most 1.")
        check_at_least(0, retry_after=self.retry_after)
        check_at_most(SUBTASK_STEPS, retry_after=self.retry_after)

    @property
    def executed(self) -> "NDArray[np.float32]":
        """Share of each of an action's values that is executed, (7,), but for `pinch_speed`."""
        import numpy as np  # not at the top, as in `clock`

        return np.array([self.speed] * 6 + [self.speed * self.jaw_speed], np.float32)

    @property
    def clock(self) -> float:
        """Control steps by which the clock advances in one."""
        return self.speed * self.clock_speed


FULL_SPEED = Pace()
"""The pace of a policy that acts as it answers."""
