"""Set-up that all tests share.

Headless GL, no network, few threads, and the recordings where present.
"""

import os

# Before any test imports mujoco, torch or the hub client: they read these once.
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("LP_NUM_THREADS", "2")
os.environ["SURGICAI_VISION_WEIGHTS"] = ""

from collections.abc import Iterator
from pathlib import Path

import pytest

from surgicai_vision.core import processes

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recordings next to the checkout; not every machine has it."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"no recordings: {folder} is not here")
    return folder


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the tests' features out of the user's cache."""
    monkeypatch.setenv("SURGICAI_VISION_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture(autouse=True)
def own_schedule() -> Iterator[None]:
    """Undo what LeRobot's recording does to a process that runs as root.

    Its SVT-AV1 makes the thread a real-time one, and every later test of this process would keep a
    core from the tests that run alongside.

    """
    with processes.kept_schedule():
        yield


@pytest.fixture
def tiny_encoder() -> Iterator[None]:
    """Offer the encoder "tiny" for as long as a test runs."""
    from tiny_encoder import TINY

    from surgicai_vision.features import encoders

    encoders.register_encoder("tiny", TINY)
    yield
    encoders.ENCODERS.unregister("tiny")
