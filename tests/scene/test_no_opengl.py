"""A machine without OpenGL: said in one line, before any work."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

WITHOUT = {**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}


@pytest.mark.parametrize("verb", ["quickstart", "release", "render-demos"])
def test_work_that_ends_in_images_is_refused_at_once(verb: str, tmp_path: Path) -> None:
    environment = {**WITHOUT, "SURGICAI_VISION_RELEASED": str(tmp_path / "released")}
    done = subprocess.run(
        [sys.executable, "-m", "surgicai_vision", verb, "--out", "out"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2, line
    assert "No image can be drawn: 'egl' gives no OpenGL" in line
    assert "apt-get install --yes --no-install-recommends libegl1 libgl1" in line
    assert not (tmp_path / "out").exists()
