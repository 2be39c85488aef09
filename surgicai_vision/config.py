"""Configuration: frozen dataclasses, the only schema. Built at the edge, saved beside every result.

`from_mapping` builds a dataclass from plain data (YAML, JSON) and refuses unknown keys with the nearest
name; `to_mapping` is its inverse; `digest` hashes the canonical JSON. Nothing here is instantiated by a
name found in a file.
"""

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from surgicai_vision import names
from surgicai_vision.errors import InputError, UnknownName, check_name

T = TypeVar("T")

STEPS: Mapping[str, tuple[float, float, float]] = types.MappingProxyType(
    {"paper": (0.5e-3, 2.0, 0.05), "released": (1.0e-3, 3.0, 0.05), "shipped": (1.5e-3, 3.0, 0.05)}
)
"""Step preset → translation [m], rotation [deg], jaw [rad] of an action of 1 (facts.md §1: the image
evaluation, the RL training script, the trajectories shipped with the release)."""


@dataclass(frozen=True)
class SceneConfig:
    """What stands in the scene. Its digest, with the geometry's version, is the scene hash.

    Attributes:
        layout: phantom layout, one of `names.LAYOUTS`.
        hole_pair: 1..4, the pair of holes the stitch goes through.
        thread: number of thread segments, 0 for none.
        instrument: PSM instrument, "400006" (Large Needle Driver of SurgicAI) or "420006".
        grasp: "friction" (contact forces only) or "attach" (a weld, the released code's rule).
    """

    layout: str = "simple"
    hole_pair: int = 1
    thread: int = 0
    instrument: str = "400006"
    grasp: str = "friction"

    def __post_init__(self) -> None:
        check_name("layout", self.layout, names.LAYOUTS)
        check_name("grasp level", self.grasp, names.GRASPS)
        check_name("instrument", self.instrument, ("400006", "420006"))
        if self.hole_pair not in (1, 2, 3, 4):
            raise InputError(f"hole_pair is {self.hole_pair!r}; allowed: 1, 2, 3, 4.")
        if self.thread not in (0, 10, 20, 40):
            raise InputError(f"thread is {self.thread!r} segments; allowed: 0, 10, 20, 40.")


@dataclass(frozen=True)
class TaskConfig:
    """One task in one scene: everything that decides what an episode is.

    Attributes:
        task: one of `names.TASKS`.
        scene: the scene.
        step: step-size preset, a key of `STEPS`.
        tolerance: "paper" or "released" success tolerances.
        reward: "sparse" (0 on success, else -1) or "dense".
        max_steps: episode limit [control steps].
    """

    task: str = "grasp"
    scene: SceneConfig = field(default_factory=SceneConfig)
    step: str = "paper"
    tolerance: str = "paper"
    reward: str = "sparse"
    max_steps: int = 200

    def __post_init__(self) -> None:
        check_name("task", self.task, names.TASKS)
        check_name("step preset", self.step, STEPS)
        check_name("tolerance preset", self.tolerance, ("paper", "released"))
        check_name("reward", self.reward, ("sparse", "dense"))
        if self.max_steps < 1:
            raise InputError(f"max_steps is {self.max_steps}; it must be at least 1.")


def from_mapping(cls: type[T], mapping: Mapping[str, Any], where: str = "configuration") -> T:
    """Build the dataclass `cls` from plain data, nested dataclasses included.

    Raises:
        UnknownName: a key that `cls` does not have.
        InputError: a value of the wrong type.
    """
    if not isinstance(mapping, Mapping):
        raise InputError(f"{where}: expected a table of keys, got {type(mapping).__name__}.")
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in mapping.items():
        if key not in hints:
            raise UnknownName(f"key in {where}", key, hints)
        values[key] = _convert(hints[key], value, f"{where}: {key}")
    return cls(**values)


def _convert(hint: Any, value: Any, where: str) -> Any:
    """Return `value` as the type `hint` says, or raise `InputError`."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(next(a for a in arguments if a is not type(None)), value, where)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_mapping(hint, value, where)
    if origin is tuple:
        if isinstance(value, str) or not isinstance(value, (list, tuple)):
            raise InputError(f"{where}: expected a list, got {value!r}.")
        return tuple(_convert(arguments[0], item, where) for item in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and (not isinstance(value, hint) or (hint is int and isinstance(value, bool))):
        raise InputError(f"{where}: expected {hint.__name__}, got {value!r}.")
    return value


def to_mapping(config: Any) -> dict[str, Any]:
    """Return a frozen dataclass as plain JSON data."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def digest(value: Any) -> str:
    """sha256 (hex) of the canonical JSON of a dataclass or of plain data."""
    plain = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
    return hashlib.sha256(json.dumps(plain, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
