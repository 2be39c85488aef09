"""The checks of `doctor`: Python, packages, import names, GL, GPU, encoders and disk.

Whatever can crash a process or takes long to import (GL, torch, the encoders) is probed in a
separate process, `python -m surgicai_vision.commands.doctor_checks PROBE`, so that a broken driver
costs one line of the report and not all of it.
"""

import importlib.metadata
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, TypedDict, cast
from urllib.parse import unquote, urlparse

from surgicai_vision.core.processes import OFFLINE, start_module

if TYPE_CHECKING:
    from packaging.requirements import Requirement

DISTRIBUTION = "surgicai-vision"
PACKAGES = ("surgicai_vision", "encoders", "policies")
GL_LINE = "sudo apt-get install --yes --no-install-recommends libegl1 libgl1"
PROBE_SECONDS = 120
DISK_GB = 5.0  # a quickstart writes well under 1 GB; 1,000 demonstrations in five views about 20
FRAMES = 30
FRAME_SIZE = 224

Status = Literal["ok", "warning", "fail"]


class FoundWeights(TypedDict):
    """What a probe found of one encoder's weights.

    Attributes:
        here: the file is on this machine.
        detail: where it is, or what is missing.
        broken: the distribution of an encoder that cannot be used, "" if it can be.
    """

    here: bool
    detail: str
    broken: str


class Finding(TypedDict, total=False):
    """What a probe found; each probe fills in its own keys, or `error`.

    Attributes:
        error: why it found nothing.
        is_plugin: the error names a part of another distribution.
    """

    error: str
    is_plugin: bool
    renderer: str
    frames_per_second: float
    devices: list[str]
    encoders: dict[str, FoundWeights]


@dataclass(frozen=True)
class Check:
    """One line of the report.

    Attributes:
        name: what was looked at.
        status: "ok", "warning" (works, or not needed by everybody) or "fail" (must be fixed).
        detail: what was found.
        advice: what to do; empty if nothing needs doing.
    """

    name: str
    status: Status
    detail: str
    advice: str = ""


def check() -> list[Check]:
    """Run every check, in the order of the report."""
    probes = {name: start_probe(name) for name in PROBES}
    return [
        check_python(),
        check_packages(),
        check_names(),
        check_gl(finish_probe(probes["gl"])),
        check_gpu(finish_probe(probes["gpu"])),
        *check_encoders(finish_probe(probes["encoders"])),
        check_disk(Path.cwd()),
    ]


def check_python(version: tuple[int, int] | None = None) -> Check:
    """Compare the running Python with the oldest one supported."""
    major, minor = version or sys.version_info[:2]
    detail = f"{major}.{minor} ({sys.executable})"
    if (major, minor) < (3, 12):
        return Check("Python", "fail", detail, "use Python 3.12 or 3.13: make setup")
    return Check("Python", "ok", detail)


def check_packages(lock: Path | None = None) -> Check:
    """Compare installed packages with requirements.lock.

    Outside a checkout they are compared with what the wheel requires.
    """
    lock = lock or Path(__file__).resolve().parents[2] / "requirements.lock"
    locked = lock.is_file()
    wanted = locked_requirements(lock) if locked else own_requirements()
    wrong = [problem for requirement in wanted if (problem := mismatch(requirement))]
    source = lock.name if locked else f"the requirements of {DISTRIBUTION}"
    if not wrong:
        return Check("packages", "ok", f"all {len(wanted)} agree with {source}")
    shown = "; ".join(wrong[:5]) + (f"; and {len(wrong) - 5} more" if len(wrong) > 5 else "")
    status: Status = "warning" if locked else "fail"
    advice = "make setup" if locked else f"pip install --upgrade {DISTRIBUTION}"
    return Check(
        "packages", status, f"{len(wrong)} of {len(wanted)} differ from {source}: {shown}", advice
    )


def locked_requirements(lock: Path) -> list["Requirement"]:
    """Return the requirements of a lock file that hold on this machine."""
    from packaging.requirements import Requirement

    lines = lock.read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line.rstrip(" \\")) for line in lines if line and line[0] not in " #-"]
    return [pin for pin in pins if pin.marker is None or pin.marker.evaluate()]


def own_requirements() -> list["Requirement"]:
    """Return the requirements the installed distribution declares, without its extras."""
    from packaging.requirements import Requirement

    declared = [Requirement(text) for text in importlib.metadata.requires(DISTRIBUTION) or ()]
    return [each for each in declared if each.marker is None or each.marker.evaluate({"extra": ""})]


def mismatch(requirement: "Requirement") -> str:
    """Return how the installed package differs from `requirement`, "" where it agrees."""
    try:
        installed = importlib.metadata.version(requirement.name)
    except importlib.metadata.PackageNotFoundError:
        return f"{requirement.name} is missing"
    if requirement.specifier.contains(installed, prereleases=True):
        return ""
    return f"{requirement.name} is {installed}, wanted {requirement.specifier}"


def check_names() -> Check:
    """Check that this distribution, and no other, owns its three import names."""
    wrong = [
        f"{name} belongs to {', '.join(sorted(who)) or 'nobody'}"
        for name in PACKAGES
        if (who := owners(name)) != {DISTRIBUTION}
    ]
    if wrong:
        return Check(
            "import names",
            "fail",
            "; ".join(wrong),
            f"pip uninstall the other distribution, so that only {DISTRIBUTION} owns them",
        )
    return Check("import names", "ok", f"{', '.join(PACKAGES)} belong to {DISTRIBUTION}")


def owners(name: str) -> set[str]:
    """Return the distributions that provide the package `name`.

    An editable install lists no files; it owns what is imported from the folder it points to.
    """
    found = set(importlib.metadata.packages_distributions().get(name, ()))
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        return found
    record = importlib.metadata.distribution(DISTRIBUTION).read_text("direct_url.json")
    source = json.loads(record or "{}")
    if source.get("dir_info", {}).get("editable"):
        folder = Path(unquote(urlparse(source["url"]).path)).resolve()
        if Path(spec.origin).resolve().parent.parent == folder:
            found.add(DISTRIBUTION)
    return found


def check_gl(finding: Finding) -> Check:
    """Report the GL renderer and its speed."""
    backend = os.environ.get("MUJOCO_GL") or "egl"
    if "error" in finding:
        if finding.get("is_plugin"):
            advice = "repair or uninstall the distribution named in the error"
        elif "renderer" in finding:
            advice = "GL works but our scene does not: report it"
        else:
            advice = GL_LINE
        return Check("GL", "fail", f"{backend}: nothing renders ({finding['error']})", advice)
    size = f"{FRAME_SIZE} × {FRAME_SIZE}"
    speed = f"{finding['frames_per_second']:.0f} frames/s of the grasp scene at {size}"
    return Check("GL", "ok", f"{backend}, {finding['renderer']}: {speed}")


def check_gpu(finding: Finding) -> Check:
    """Report the GPU torch can use; having none is no fault."""
    if "error" in finding:
        return Check("GPU", "fail", f"torch does not import ({finding['error']})", "make setup")
    if finding["devices"]:
        return Check("GPU", "ok", ", ".join(finding["devices"]))
    if shutil.which("nvidia-smi"):
        return Check(
            "GPU",
            "warning",
            "an NVIDIA driver is installed, but torch sees no GPU",
            "check the output of nvidia-smi",
        )
    return Check("GPU", "ok", "none; everything runs on the CPU")


def check_encoders(finding: Finding) -> Iterator[Check]:
    """Report, for every registered encoder, whether its weights are on this machine."""
    if "error" in finding:
        yield Check("encoders", "fail", finding["error"], "make setup")
        return
    for name, found in finding["encoders"].items():
        status: Status = "ok" if found["here"] else "warning"
        advice = (
            "" if found["here"] else "needed only for this encoder: a network, or --weights FILE"
        )
        if owner := found["broken"]:
            status = "fail"
            advice = "make setup" if owner == DISTRIBUTION else f"repair or uninstall {owner}"
        yield Check(f"encoder {name}", status, found["detail"], advice)


def check_disk(folder: Path) -> Check:
    """Report the free space where outputs are written."""
    free = shutil.disk_usage(folder).free / 1e9
    detail = f"{free:.0f} GB free in {folder}"
    if free < DISK_GB:
        return Check(
            "disk",
            "warning",
            detail,
            f"free at least {DISK_GB:.0f} GB, or give --out on another disk",
        )
    return Check("disk", "ok", detail)


def start_probe(name: str) -> subprocess.Popen[str]:
    """Start a probe in its own process, off the network and with a headless GL."""
    variables = {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"), **OFFLINE}
    return start_module("surgicai_vision.commands.doctor_checks", name, variables=variables)


def finish_probe(process: subprocess.Popen[str]) -> Finding:
    """Return what a probe found, or {"error": why} where it crashed, hung or said nothing."""
    try:
        output, complaint = process.communicate(timeout=PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return {"error": f"no answer within {PROBE_SECONDS} s"}
    lines = output.strip().splitlines()
    if process.returncode == 0 and lines:
        return cast(Finding, json.loads(lines[-1]))
    reasons = complaint.strip().splitlines()
    return {"error": reasons[-1] if reasons else f"ended with code {process.returncode}"}


def probe_gl() -> Finding:
    """Open a GL context, then render the grasp scene in it and time that."""
    from surgicai_vision.core.errors import InputError, SurgicaiError
    from surgicai_vision.scene.rendering import renderer_string

    try:
        finding: Finding = {"renderer": renderer_string()}
    except SurgicaiError as error:
        return {"error": str(error)}
    try:
        finding["frames_per_second"] = rendering_speed()
    except Exception as error:  # reported in its own line; the context above was created
        # The user gave no input here, so wrong input means another distribution's camera.
        finding["is_plugin"] = isinstance(error, InputError)
        finding["error"] = (
            str(error) if finding["is_plugin"] else f"{type(error).__name__}: {error}"
        )
    return finding


def rendering_speed() -> float:
    """Return how many frames/s of the grasp scene's front view this machine renders."""
    from surgicai_vision import envs
    from surgicai_vision.core.config import TaskConfig
    from surgicai_vision.scene.rendering import FrameRenderer

    env = envs.make(TaskConfig())
    env.reset(seed=0)
    with FrameRenderer(env.model, FRAME_SIZE, FRAME_SIZE) as renderer:
        renderer.render(env.data, "front")
        begin = time.perf_counter()
        for _ in range(FRAMES):
            renderer.render(env.data, "front")
        return FRAMES / (time.perf_counter() - begin)


def probe_gpu() -> Finding:
    """List the GPUs torch can use."""
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    return {"devices": [torch.cuda.get_device_name(index) for index in range(count)]}


def probe_encoders() -> Finding:
    """Look for each encoder's weights; the parent has cut off the network."""
    from surgicai_vision.features import encoders

    return {"encoders": {name: _found_weights(name) for name in encoders.encoder_names()}}


def _found_weights(name: str) -> FoundWeights:
    """Look for one encoder's weights."""
    from surgicai_vision.core.errors import MissingWeights, SurgicaiError, first_line
    from surgicai_vision.features import encoders

    try:
        card = encoders.encoder_card(name)
    except Exception as error:  # whatever it is, the other encoders are still reported
        owner = encoders.ENCODERS.distribution(name)
        return {"here": False, "detail": first_line(error), "broken": owner}
    unpinned = "" if card.sha256 else " (unpinned: the Hub's own hash is used)"
    try:
        path = encoders.find_weights(name, encoders.WeightsSource(accept_licence=True))
    except MissingWeights:
        detail = f"{card.filename} of {card.source} is not on this machine{unpinned}"
        return {"here": False, "detail": detail, "broken": ""}
    except SurgicaiError as error:
        return {"here": False, "detail": str(error), "broken": ""}
    detail = f"{path}{unpinned}" if path else f"{card.source} {card.revision}, always available"
    return {"here": True, "detail": detail, "broken": ""}


PROBES: MappingProxyType[str, Callable[[], Finding]] = MappingProxyType(
    {"gl": probe_gl, "gpu": probe_gpu, "encoders": probe_encoders}
)


if __name__ == "__main__":
    print(json.dumps(PROBES[sys.argv[1]]()))
