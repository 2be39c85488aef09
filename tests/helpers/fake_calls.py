"""Calls for the tests of processes; imported by their children."""

import os
import signal
import sys
import time

from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.processes import Child, start_module


def count(number, report):
    for done in range(number):
        report(done)
        time.sleep(0.02)
    return number


def refuse(report):
    raise UnknownName("camera", "frnt", ["front"])


def crash(report):
    raise ZeroDivisionError("by hand")


def read_nothing(report):
    raise EOFError("No data left in file")


def die(report):
    os.kill(os.getpid(), signal.SIGKILL)


def sleep(seconds, report):
    time.sleep(seconds)


def tell_environment(connection):
    connection.send({name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "MINE")})


def have_children(connection):
    """Start a child and a program, and send their process ids."""
    child = Child(wait)
    module = start_module("fake_calls", "60")
    connection.send([os.getpid(), child.connection.recv(), module.pid])
    connection.recv()


def wait(connection):
    connection.send(os.getpid())
    connection.recv()


def stay(connection):
    """Wait without noticing the end of the pipe."""
    time.sleep(60)


if __name__ == "__main__":
    if sys.argv[1] == "refuse":
        raise InputError("bad input")
    print(sys.argv[1], os.environ["OMP_NUM_THREADS"])
    time.sleep(float(sys.argv[1]))
