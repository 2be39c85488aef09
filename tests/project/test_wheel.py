"""Wheel and sdist.

Both are built; the wheel is installed without our other files and used from another folder.
"""

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

SMOKE = """
import importlib.metadata, pathlib, sys
import surgicai_vision, encoders, policies
from surgicai_vision.core.files import configs_folder
from surgicai_vision.features.encoders import encoder_card
for module in (surgicai_vision, encoders, policies):
    assert pathlib.Path(module.__file__).is_relative_to(sys.argv[1]), module.__file__
site = pathlib.Path(sys.argv[1])
assert configs_folder() == site / "surgicai_vision" / "configs", configs_folder()
assert (configs_folder() / "README.md").is_file()
assert encoder_card("imagenet-lite").offline
owners = importlib.metadata.packages_distributions()
for name in ("surgicai_vision", "encoders", "policies"):
    assert set(owners[name]) == {"surgicai-vision"}, owners[name]
assert importlib.metadata.version("surgicai-vision") == surgicai_vision.__version__
"""


@pytest.fixture(scope="module")
def built(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Wheel and sdist; the wheel is made from the sdist, so that both are complete."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(root)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, sdist


def test_wheel_holds_the_three_packages_and_nothing_else(
    built: tuple[Path, Path], root: Path
) -> None:
    contents = zipfile.ZipFile(built[0]).namelist()
    assert {name.split("/")[0].split("-")[0] for name in contents} == {
        "surgicai_vision",
        "encoders",
        "policies",
    }
    sources = {
        f"{path.relative_to(root)}"
        for name in ("surgicai_vision", "encoders", "policies")
        for path in (root / name).rglob("*")
        if path.suffix in (".py", ".js", ".css", ".j2")
    }
    assert sources <= set(contents)
    # PEP 561: type checkers read our annotations in an installed package as well.
    marked = {f"{name}/py.typed" for name in ("surgicai_vision", "encoders", "policies")}
    assert marked <= set(contents)
    configs = {
        f"surgicai_vision/{path.relative_to(root)}"
        for path in (root / "configs").rglob("*")
        if path.is_file()
    }
    assert configs <= set(contents)
    released = (root / "surgicai_vision" / "released").glob("*/*")
    assert {f"{path.relative_to(root)}" for path in released} <= set(contents)


def test_sdist_ships_neither_data_nor_tests(built: tuple[Path, Path]) -> None:
    with tarfile.open(built[1]) as archive:
        tops = {Path(name).parts[1] for name in archive.getnames() if len(Path(name).parts) > 1}
    assert {
        "surgicai_vision",
        "encoders",
        "policies",
        "configs",
        "pyproject.toml",
        "README.md",
        "LICENSE",
    } <= tops
    assert not tops & {"data", "tests", "outputs", ".venv"}


@pytest.fixture(scope="module")
def installed(
    built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, str]]:
    """An environment with only the wheel, and variables that lend it the dependencies.

    PYTHONPATH lends only the contents of this environment's site-packages; its .pth files, and
    so our editable install, are not read from there.
    """
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    site = folder / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    zipfile.ZipFile(built[0]).extractall(site)
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COV"))
    }
    lent = f"{site}{os.pathsep}{sysconfig.get_path('purelib')}"
    return folder, {**environment, "PYTHONPATH": lent, "PYTHONSAFEPATH": "1"}


def test_wheel_works_from_another_folder(
    installed: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    folder, environment = installed
    site = environment["PYTHONPATH"].split(os.pathsep)[0]
    command = [str(folder / "bin" / "python"), "-c", SMOKE, site]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["quickstart", "--help"], ["evaluate", "--help"]]
)
def test_command_of_the_wheel_answers(
    installed: tuple[Path, dict[str, str]], tmp_path: Path, arguments: list[str]
) -> None:
    folder, environment = installed
    command = [
        str(folder / "bin" / "python"),
        "-c",
        "from surgicai_vision.commands.main import main; main()",
        *arguments,
    ]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "surgicai-vision" in result.stdout
    assert not list(tmp_path.iterdir())
