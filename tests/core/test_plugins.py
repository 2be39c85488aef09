"""Plug-ins: our own parts, registered ones, those of other distributions, and name collisions."""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from policies.bc import BC
from surgicai_vision import (
    register_camera,
    register_encoder,
    register_engine,
    register_policy,
    register_task,
)
from surgicai_vision.core import cameras, names
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.plugins import CAMERAS_GROUP, NameCollision, Registry, instance_of
from surgicai_vision.envs.subtask import Subtask
from surgicai_vision.scene.cameras import CameraPose

GROUP = "surgicai_vision.numbers"


def install(folder: Path, name: str, points: str, group: str = GROUP) -> None:
    """Write the metadata of an installed distribution, as pip does."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{points}\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed distributions on the search path."""
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def numbers() -> Registry[float]:
    return Registry[float]("number", GROUP, {"pi": "math:pi"})


def test_ours_are_found_by_name_and_imported_on_use() -> None:
    registry = numbers()
    assert registry.names() == ("pi",)
    assert registry.load("pi") == pytest.approx(3.14159, abs=1e-5)
    assert registry.owner("pi") == "surgicai-vision"


def test_a_misspelt_name_is_told_the_nearest() -> None:
    with pytest.raises(UnknownName, match="Did you mean 'pi'"):
        numbers().load("pie")


def test_a_registered_part_stands_beside_ours() -> None:
    registry = numbers()
    registry.register("answer", 42.0, distribution="mine")
    assert registry.load("answer") == 42.0
    assert registry.names() == ("pi", "answer")
    with pytest.raises(NameCollision, match=r"'pi'.*'surgicai-vision'.*'mine'"):
        registry.register("pi", 3.0, distribution="mine")
    with pytest.raises(NameCollision, match=r"'answer' is offered twice by 'mine'; .*Python anew"):
        registry.register("answer", 43.0, distribution="mine")


def test_entry_points_of_installed_distributions_are_read(site: Path) -> None:
    install(site, "their-numbers", "tau = math:tau")
    registry = numbers()
    assert registry.load("tau") == pytest.approx(6.28318, abs=1e-5)
    assert registry.owner("tau") == "their-numbers"


def test_a_collision_names_both_distributions(site: Path) -> None:
    install(site, "their-numbers", "pi = math:e\ntau = math:tau")
    registry = numbers()
    assert registry.names() == ("pi", "tau")
    assert registry.check("tau") == "tau"
    for look_up in (registry.check, registry.load, registry.owner):
        with pytest.raises(NameCollision, match=r"'surgicai-vision'.*'their-numbers'"):
            look_up("pi")


def test_a_camera_that_two_distributions_offer_is_in_no_scene(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = dict.fromkeys(names.CAMERAS, "math:pi")
    monkeypatch.setattr(cameras, "CAMERAS", Registry("camera", CAMERAS_GROUP, ours))
    install(site, "their-cameras", "side = math:pi\nabove = math:pi", CAMERAS_GROUP)
    install(site, "more-cameras", "side = math:pi", CAMERAS_GROUP)
    assert cameras.other_cameras() == ("above",)
    with pytest.raises(NameCollision, match=r"'side'.*-cameras'.*-cameras'"):
        cameras.check_camera("side")


@pytest.mark.parametrize(
    ("target", "code", "reason"),
    [
        ("no_such_module:x", "", "cannot be imported: No module named 'no_such_module'"),
        ("their_module:x", "", "cannot be imported: AttributeError: .*'x'"),
        ("their_module:x", "1 / 0", r"cannot be imported: ZeroDivisionError: .*line 1\)"),
        ("their_module:x", "x = 'seven'", "is 'seven'; it must be an instance of numbers.Number"),
    ],
)
def test_a_part_that_cannot_be_used_is_told_with_its_distribution(
    site: Path, monkeypatch: pytest.MonkeyPatch, target: str, code: str, reason: str
) -> None:
    monkeypatch.delitem(sys.modules, "their_module", raising=False)
    (site / "their_module.py").write_text(code)
    install(site, "their-numbers", f"gone = {target}")
    registry = Registry[float]("number", GROUP, {}, instance_of("numbers:Number"))
    with pytest.raises(InputError, match=f"The number 'gone' of 'their-numbers' {reason}"):
        registry.load("gone")


@pytest.mark.parametrize(
    ("raised", "kind", "message"),
    [
        (TypeError("no"), InputError, r"The number 'mine' of 'me' failed: TypeError: no \("),
        (UnknownName("key", "a", "b"), UnknownName, r"The number 'mine' of 'me': Unknown key 'a'"),
    ],
)
def test_an_error_of_a_parts_code_says_whose_it_is(
    raised: Exception, kind: type[Exception], message: str
) -> None:
    registry = numbers()
    registry.register("mine", 1.0, distribution="me")
    with pytest.raises(kind, match=message), registry.calling("mine"):
        raise raised
    with pytest.raises(ZeroDivisionError), registry.calling("pi"):
        raise ZeroDivisionError


PARTS: dict[str, tuple[Callable[[], object], str]] = {
    "encoder": (lambda: register_encoder("x", cast(Any, min)), "must be an instance of encoders"),
    "policy": (lambda: register_policy("x", cast(Any, min)), "must be an instance of policies"),
    "recipe": (
        lambda: register_policy("x", dataclasses.replace(BC, recipe=cast(Any, dict))),
        "has a recipe that is <class 'dict'>; it must be a frozen dataclass",
    ),
    "fields": (
        lambda: register_policy("x", dataclasses.replace(BC, recipe=cast(Any, Point))),
        "has a recipe without batch_norm,",
    ),
    "task": (lambda: register_task(cast(Any, int)), "must be a subclass of .*Subtask"),
    "methods": (
        lambda: register_task(cast(Any, Abstract)),
        "lacks what .* requires: start, target",
    ),
    "tolerances": (lambda: register_task(Intolerant), "lacks tolerances and demands"),
    "camera": (lambda: register_camera("x", cast(Any, {})), "must be a scene.cameras.CameraPose"),
    "class": (lambda: register_camera("x", cast(Any, CameraPose)), "is <class"),
    "engine": (lambda: register_engine(cast(Any, int)), "must be a subclass of .*Engine"),
}


@dataclasses.dataclass(frozen=True)
class Point:
    """A dataclass that is not a recipe."""


class Abstract(Subtask):
    """A task without its methods."""

    name = "x"


class Intolerant(Abstract):
    """A task without tolerances."""

    arm = "psm1"

    def start(self, *_: object) -> bool:
        return True

    def target(self, *_: object) -> Any:
        return None


@pytest.mark.parametrize("kind", PARTS)
def test_what_is_no_part_is_refused_where_it_is_registered(kind: str) -> None:
    register, message = PARTS[kind]
    with pytest.raises(InputError, match=rf"^The \w+ '.*' of '.*' .*{message}"):
        register()
