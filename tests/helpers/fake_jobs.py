"""Jobs for the tests of the executor; imported by its worker processes."""

import os
import signal
import time
from pathlib import Path

from surgicai_vision.core.errors import InputError, UnknownName


def square(folder, number):
    (folder / "result.txt").write_text(f"{number * number}")


def count(folder, number, log):
    with open(log, "a") as file:
        file.write(f"{number}\n")
    square(folder, number)


def die_once(folder, mark):
    if not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / "result.txt").write_text("done")


def die(folder):
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(folder, kind):
    (folder / "half.txt").write_text("half")
    raise {"input": InputError("bad input"), "name": UnknownName("camera", "frnt", ["front"])}[kind]


def crash(folder):
    raise ZeroDivisionError("by hand")


def slow(folder, number, seconds):
    time.sleep(seconds)
    square(folder, number)


def environment(folder):
    (folder / "result.txt").write_text(os.environ.get("LP_NUM_THREADS", "unset"))


def where(folder):
    import ray

    (folder / "result.txt").write_text(
        f"{ray.util.get_node_ip_address()} {os.environ['LP_NUM_THREADS']}"
    )
