"""The distribution: the names it owns, its lock, hosts that no file may name, doctor."""

import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from surgicai_vision.commands import doctor_checks

PACKAGES = ("surgicai_vision", "encoders", "policies")
# Spelt in pieces, so that this file passes its own test.
REGISTRY_HOSTS = (
    "py" + "pi.org",
    "python" + "hosted.org",
    "npm" + "js.org",
    "npm" + "js.com",
    "deb." + "debian.org",
)


@pytest.fixture(scope="module")
def tracked(root: Path) -> list[Path]:
    """Every file that git tracks or would track."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    if not (root / ".git").exists():
        pytest.skip("not a git checkout")
    output = subprocess.run(command, cwd=root, capture_output=True, check=True, text=True).stdout
    return [root / name for name in output.split("\0") if name and (root / name).is_file()]


@pytest.mark.parametrize("package", PACKAGES)
def test_this_distribution_alone_owns_its_import_names(package: str) -> None:
    assert doctor_checks.owners(package) == {"surgicai-vision"}


def test_doctor_finds_a_foreign_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    foreign = {"encoders": ["other"], "policies": ["surgicai-vision"]}
    monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: foreign)
    check = doctor_checks.check_names()
    assert check.status == "fail"
    assert "other" in check.detail
    assert "policies" not in check.detail


def test_doctor_names_what_is_broken_and_reports_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    from surgicai_vision.features import encoders

    def card(name: str) -> object:
        if name == "random":
            raise RuntimeError("no luck")
        return real(name)

    real = encoders.encoder_card
    monkeypatch.setattr(encoders, "encoder_card", card)
    monkeypatch.setattr(encoders, "encoder_names", lambda: ("random", "random-conv"))
    monkeypatch.setattr(encoders.ENCODERS, "distribution", lambda _: "theirs")
    broken, other = doctor_checks.check_encoders(doctor_checks.probe_encoders())
    assert (broken.status, broken.detail) == ("fail", "no luck")
    assert broken.advice == "repair or uninstall theirs"
    assert other.status == "ok"
    finding: doctor_checks.Finding = {"renderer": "llvmpipe", "error": "x", "is_plugin": True}
    assert "uninstall" in doctor_checks.check_gl(finding).advice


def locked_packages(lock: Path) -> dict[str, str]:
    """Pinned line → the text of its hashes."""
    blocks = re.split(r"(?m)^(?=\S)", lock.read_text())
    return {
        block.splitlines()[0]: block
        for block in blocks
        if block.strip() and not block.startswith("#")
    }


@pytest.mark.parametrize("name", ["requirements.lock", "scripts/uv.txt"])
def test_the_lock_pins_and_hashes_everything_and_names_no_address(root: Path, name: str) -> None:
    packages = locked_packages(root / name)
    assert packages
    for line, block in packages.items():
        assert re.match(r"[A-Za-z0-9._-]+(\[[a-z,]+\])?==[^ ]+", line), line
        assert "--hash=sha256:" in block, line
    text = (root / name).read_text()
    assert "://" not in text
    assert not re.search(r"(?m)^\s*--(?!hash)", text)


def test_the_lock_holds_every_dependency(root: Path) -> None:
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    pins = {pin.name: pin for pin in doctor_checks.locked_requirements(root / "requirements.lock")}
    for text in importlib.metadata.requires("surgicai-vision") or ():
        wanted = Requirement(text)
        pin = pins[canonicalize_name(wanted.name)]
        assert wanted.specifier.contains(next(iter(pin.specifier)).version), (text, pin)


def test_no_file_names_a_package_registry(tracked: list[Path]) -> None:
    pattern = "|".join(map(re.escape, REGISTRY_HOSTS))
    guilty = [path for path in tracked if re.search(pattern.encode(), path.read_bytes())]
    assert not guilty


def test_uv_lock_and_outputs_stay_out_of_git(tracked: list[Path], root: Path) -> None:
    assert not [
        path for path in tracked if path.name == "uv.lock" or (root / "outputs") in path.parents
    ]


def test_setup_refuses_a_python_that_exists_and_fails(root: Path, tmp_path: Path) -> None:
    """A pyenv shim is in PATH under the right name and fails when it is run."""
    shim = tmp_path / "python3.12"
    shim.write_text("#!/bin/sh\nexit 127\n")
    shim.chmod(0o755)
    text = (root / "scripts" / "setup.sh").read_text()
    function = re.search(r"(?ms)^python_works\(\) \{.*?^\}", text)
    assert function
    script = f'{function.group()}\npython_works "$1" && echo works || echo broken'

    def ask(python: str) -> str:
        command = ["sh", "-c", script, "sh", python]
        return subprocess.run(command, capture_output=True, check=True, text=True).stdout.strip()

    assert ask(str(shim)) == "broken"
    assert ask(sys.executable) == "works"
    assert ask(str(tmp_path / "absent")) == "broken"


def test_gl_probe_says_which_library_is_missing(root: Path) -> None:
    script = (
        "import ctypes, runpy, sys\n"
        "def nothing(name, **_): raise OSError(name)\n"
        "ctypes.CDLL = nothing\n"
        f"runpy.run_path({str(root / 'scripts' / 'gl_probe.py')!r}, run_name='__main__')\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 1
    assert "libEGL.so.1" in result.stderr


def test_doctor_reports_every_line_with_advice_where_something_is_wrong() -> None:
    checks = doctor_checks.check()
    assert {check.name for check in checks} >= {
        "Python",
        "packages",
        "import names",
        "GL",
        "GPU",
        "disk",
    }
    for check in checks:
        assert check.status in ("ok", "warning", "fail")
        assert check.detail
        assert (check.status == "ok") == (check.advice == ""), check


def test_doctor_names_gl_renderer_and_speed() -> None:
    finding = doctor_checks.finish_probe(doctor_checks.start_probe("gl"))
    check = doctor_checks.check_gl(finding)
    assert check.status == "ok", check
    assert "frames/s" in check.detail
    assert finding["renderer"] in check.detail


def test_doctor_tells_a_missing_gl_from_a_broken_scene() -> None:
    assert "apt-get" in doctor_checks.check_gl({"error": "no EGL"}).advice
    assert "report" in doctor_checks.check_gl({"renderer": "llvmpipe", "error": "no camera"}).advice


def test_doctor_knows_which_encoders_work_offline() -> None:
    checks = {
        check.name: check
        for check in doctor_checks.check_encoders(
            doctor_checks.finish_probe(doctor_checks.start_probe("encoders"))
        )
    }
    assert checks["encoder imagenet-lite"].status == "ok"
    assert checks["encoder random"].status == "ok"
    if not os.environ.get("SURGICAI_VISION_WEIGHTS"):
        assert all(check.status in ("ok", "warning") for check in checks.values())


def test_doctor_survives_a_probe_that_dies() -> None:
    finding = doctor_checks.finish_probe(doctor_checks.start_probe("no such probe"))
    assert "no such probe" in finding["error"]
    assert doctor_checks.check_gl(finding).status == "fail"
    assert doctor_checks.check_gpu(finding).status == "fail"
    assert [check.status for check in doctor_checks.check_encoders(finding)] == ["fail"]


def test_doctor_finds_old_python_and_wrong_packages(tmp_path: Path) -> None:
    assert doctor_checks.check_python((3, 11)).status == "fail"
    lock = tmp_path / "requirements.lock"
    lock.write_text(
        "numpy==0.0.1 \\\n    --hash=sha256:00\nno-such-package==1 ; sys_platform == 'linux'\n"
    )
    check = doctor_checks.check_packages(lock)
    assert check.status == "warning"
    assert "numpy is " in check.detail
    assert "no-such-package is missing" in check.detail
    lock.write_text("no-such-package==1 ; sys_platform == 'nowhere'\n")
    assert doctor_checks.check_packages(lock).status == "ok"
