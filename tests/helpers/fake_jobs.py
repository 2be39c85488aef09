"""Jobs for the tests of the executor; imported by its worker processes."""

import functools
import os
import signal
import time
from pathlib import Path

from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.executor import job

fake = functools.partial(job, stages=("core",), packages=("numpy",))


@fake("square")
def square(folder, number):
    (folder / "result.txt").write_text(f"{number * number}")


@fake("count")
def count(folder, number, log):
    with open(log, "a") as file:
        file.write(f"{number}\n")
    square(folder, number)


@fake("die_once")
def die_once(folder, mark):
    if not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / "result.txt").write_text("done")


@fake("die")
def die(folder):
    os.kill(os.getpid(), signal.SIGKILL)


@fake("refuse")
def refuse(folder, kind):
    (folder / "half.txt").write_text("half")
    raise {"input": InputError("bad input"), "name": UnknownName("camera", "frnt", ["front"])}[kind]


@fake("crash")
def crash(folder):
    raise ZeroDivisionError("by hand")


@fake("slow")
def slow(folder, number, seconds):
    time.sleep(seconds)
    square(folder, number)


@fake("environment")
def environment(folder):
    (folder / "result.txt").write_text(os.environ.get("LP_NUM_THREADS", "unset"))


@fake("where")
def where(folder):
    import ray

    (folder / "result.txt").write_text(
        f"{ray.util.get_node_ip_address()} {os.environ['LP_NUM_THREADS']}"
    )
