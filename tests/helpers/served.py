"""Serves a simulation in a separate process, as a person would."""

import contextlib
import os
import subprocess
import sys

DOMAIN = 1 + os.getpid() % 200
"""A domain for this process alone, so that parallel tests do not interfere."""


@contextlib.contextmanager
def serving(*options, domain=DOMAIN):
    """Run `robot serve` with the options; yield the process."""
    command = [sys.executable, "-m", "surgicai_vision", "robot", "serve", *options]
    process = subprocess.Popen(
        [*command, "--domain", str(domain)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "MUJOCO_GL": "egl"},
    )
    try:
        line = process.stderr.readline()
        assert "serving" in line, line + process.stderr.read()
        yield process
    finally:
        process.terminate()
        process.wait(20)
        process.stderr.close()
