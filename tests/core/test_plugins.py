"""Plug-ins: our parts, registered ones, those of other distributions, and collisions of names."""

from pathlib import Path

import pytest

from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.plugins import NameCollision, Registry

GROUP = "surgicai_vision.numbers"


def install(folder: Path, name: str, points: str) -> None:
    """Lay down the metadata of an installed distribution, as pip does."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{points}\n")


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


def test_a_part_that_cannot_be_imported_is_told_with_its_distribution(site: Path) -> None:
    install(site, "their-numbers", "gone = no_such_module:x")
    with pytest.raises(InputError, match=r"'gone' of 'their-numbers'.*no_such_module"):
        numbers().load("gone")
