"""Processes: the one way in which this package starts others.

Children are spawned, since a fork would copy a GL context and torch's threads. A child ends with
the process that started it, however that one ended: a thread of the child checks twice a second
whether its parent still exists. Grandchildren do the same, so a killed run leaves nothing alive
after about a second. (Linux can send a signal on a parent's death, but it sends it on the death of
the *thread* that started the child.)

Three kinds:

* `Child`: a function at the other end of a pipe, for as long as it runs.
* `Worker`: a child that does one call after another; `run_all` does several calls at once.
* `run_module`, `start_module`: a Python module as a separate program.
"""

import atexit
import functools
import multiprocessing
import multiprocessing.util  # its exit handler must be registered before ours, to run after it
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from types import FrameType, MappingProxyType
from typing import Protocol, Self, TypeVar, cast, final

from surgicai_vision.core.errors import InputError, SurgicaiError

ONE_THREAD: Mapping[str, str] = MappingProxyType(
    {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
)
"""Environment of a child that has a core to itself: the threads of llvmpipe and the BLAS would
compete for it (measured: two single-threaded processes scale linearly)."""

OFFLINE: Mapping[str, str] = MappingProxyType({"HF_HUB_OFFLINE": "1"})
"""Environment of a child that must find all it needs on this machine."""


@contextmanager
def kept_schedule() -> Iterator[None]:
    """Restore this thread's scheduling at the end.

    As root, SVT-AV1 makes the thread that opens it a real-time one (SCHED_FIFO, priority 99): all
    that the process does from then on would stop everything else on its core.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


T = TypeVar("T")

WATCH_S = 0.5
"""Interval at which a child looks for its parent [s]."""

PATIENCE_S = 10.0
"""How long a dismissed child may take to exit before it is killed [s]."""


REPORT_S = 0.1
"""Shortest time between two reports of a call [s]."""


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived; it unwinds as Ctrl-C does."""


def raise_on_terminate() -> None:
    """Let the first SIGTERM raise `Terminated` in the main thread, and a second one end at once."""

    def terminate(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        raise Terminated

    if threading.current_thread() is threading.main_thread():  # Python allows no other
        signal.signal(signal.SIGTERM, terminate)


@contextmanager
def _termination_waits() -> Iterator[None]:
    """Delay a SIGTERM or a Ctrl-C that arrives inside until the end.

    A starting child reads its instructions from a pipe; interrupted halfway, it would print a
    traceback in addition to our one line.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # the signals arrive in the main thread, which is elsewhere
        return
    arrived: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        arrived.append(number)

    handlers = {kind: signal.signal(kind, note) for kind in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for kind, handler in handlers.items():
            signal.signal(kind, signal.SIG_DFL if handler is None else handler)
    if arrived:
        signal.raise_signal(arrived[0])


def end_with_parent(parent: int) -> None:
    """Let this process end as soon as `parent` is no longer its parent."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for the processes started inside."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@dataclass(frozen=True)
class Failure:
    """An exception as plain data, since not every exception can be pickled.

    Attributes:
        exit_code: of a `SurgicaiError`, else 1.
        message: its text, with its type where it was no `SurgicaiError`.
        trace: its traceback; "" for a `SurgicaiError`, which says all in its message.
    """

    exit_code: int
    message: str
    trace: str = ""

    @classmethod
    def of(cls, error: Exception) -> Self:
        """Return the exception that is being handled as plain data."""
        if isinstance(error, SurgicaiError):
            return cls(error.exit_code, str(error))
        return cls(1, f"{type(error).__name__}: {error}", traceback.format_exc())

    def as_error(self, what: str) -> SurgicaiError:
        """Return an exception to raise, its traceback in a note.

        Args:
            what: what failed, the beginning of the message of an unexpected failure.
        """
        if not self.trace:
            kind = InputError if self.exit_code == InputError.exit_code else SurgicaiError
            return kind(self.message)
        error = SurgicaiError(f"{what} failed: {self.message}")
        error.add_note(self.trace)
        return error


class Died(Exception):
    """A child died before it answered.

    Attributes:
        exit_code: its exit code; negative is the number of the signal that killed it.
    """

    def __init__(self, exit_code: int | None):
        super().__init__(f"The process died (exit code {exit_code}).")
        self.exit_code = exit_code


_children: "weakref.WeakSet[Child]" = weakref.WeakSet()


@final
class Child:
    """A spawned process that serves one end of a pipe and ends with this one.

    Attributes:
        connection: this end of the pipe; readable when the child has sent something or is dead.
    """

    def __init__(
        self,
        serve: Callable[..., None],
        *arguments: object,
        variables: Mapping[str, str] = ONE_THREAD,
    ):
        """Start a child.

        Args:
            serve: called in the child as `serve(connection, *arguments)`; module-level.
            arguments: picklable, or shared memory of multiprocessing.
            variables: environment variables of the child, in addition to this process's.
        """
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        handed = (_ParentWatch(os.getpid()), theirs, serve, arguments)
        with environment(variables), _termination_waits():
            self._process = context.Process(target=_live, args=handed)
            self._process.start()
        theirs.close()  # the child alone holds that end now: it closes when the child dies
        _children.add(self)

    @property
    def pid(self) -> int | None:
        """Return the child's process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Return the child's exit code, None while it lives."""
        return self._process.exitcode

    def join(self) -> None:
        """Wait a while for a child that is about to exit."""
        self._process.join(PATIENCE_S)

    def dismiss(self) -> None:
        """Close the pipe and let the child exit cleanly (it frees its GL context), or kill it."""
        self.connection.close()
        self.join()
        self.end()

    def end(self) -> None:
        """End the child at once."""
        self.connection.close()
        self._process.kill()
        self._process.join()
        _children.discard(self)


@atexit.register
def _end_children() -> None:
    """End the remaining children, which multiprocessing would wait for."""
    for child in list(_children):
        child.end()


@final
class _ParentWatch:
    """Starts the watch while a child reads its arguments, before it imports what they need."""

    def __init__(self, parent: int):
        self.parent = parent

    def __reduce__(self) -> tuple[Callable[[int], None], tuple[int]]:
        return end_with_parent, (self.parent,)


def _live(
    _: None, connection: Connection, serve: Callable[..., None], arguments: tuple[object, ...]
) -> None:
    """Serve one end of a pipe; the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with connection, suppress(EOFError, BrokenPipeError, ConnectionResetError):
        serve(connection, *arguments)


class Report(Protocol):
    """Reports the progress of a call."""

    def __call__(self, value: int, /) -> None:
        """Receive or send a number."""


@dataclass(frozen=True)
class Done:
    """What a call returned."""

    value: object


@dataclass(frozen=True)
class _Reported:
    """The progress of a call."""

    value: int


@final
class Worker:
    """A child that does one call after another.

    Attributes:
        connection: readable when there is something to receive, or the child is dead.
    """

    def __init__(self, variables: Mapping[str, str] = ONE_THREAD):
        self._child = Child(_serve_calls, variables=variables)
        self._hear: Report | None = None
        self.connection = self._child.connection

    def call(
        self, function: Callable[..., object], *arguments: object, hear: Report | None = None
    ) -> None:
        """Send the child a call.

        Args:
            function: a module-level function, or a partial of one.
            arguments: its arguments, picklable.
            hear: receives what the function reports; the function gets `report=` for that.
        """
        self._hear = hear
        with suppress(OSError):  # already dead: `receive` says so
            self.connection.send((function, arguments, hear is not None))

    def receive(self) -> Done | Failure | None:
        """Wait for a message; return how the call ended, or None where it only reported.

        Raises:
            Died: the child died.
        """
        try:
            message: Done | Failure | _Reported = self.connection.recv()
        except (OSError, EOFError):
            self._child.join()
            raise Died(self._child.exit_code) from None
        if isinstance(message, _Reported):
            if self._hear:
                self._hear(message.value)
            return None
        return message

    def dismiss(self) -> None:
        """Let an idle child exit cleanly."""
        self._child.dismiss()

    def end(self) -> None:
        """End the child at once."""
        self._child.end()


def _serve_calls(connection: Connection) -> None:
    """Do calls until the connection ends."""
    while True:
        message: Done | Failure
        try:
            function, arguments, reports = connection.recv()
        except (EOFError, ConnectionResetError):
            return
        more = {"report": _sender(connection)} if reports else {}
        try:
            message = Done(function(*arguments, **more))
        except Exception as error:
            message = Failure.of(error)
        try:
            connection.send(message)
        except (BrokenPipeError, ConnectionResetError):
            return


def _sender(connection: Connection) -> Report:
    """Return a function that sends numbers, at most a few per second."""
    last = time.monotonic()

    def report(value: int) -> None:
        nonlocal last
        if time.monotonic() - last >= REPORT_S:
            connection.send(_Reported(value))
            last = time.monotonic()

    return report


def run_all(
    calls: Sequence[Callable[..., T]],
    what: str,
    hear: Callable[[Sequence[int]], None],
    variables: Mapping[str, str] = ONE_THREAD,
) -> list[T]:
    """Do each call in its own worker, all at once; return what they return, in order.

    Args:
        calls: module-level functions or partials of them; each gets `report=` for its progress.
        what: what is done, for the message about an unexpected failure.
        hear: receives what each call reported last.
        variables: environment variables of the workers.

    Raises:
        SurgicaiError: a call failed or a worker died; the others are ended.
    """
    reported = [0] * len(calls)
    results: dict[int, T] = {}
    workers = [Worker(variables) for _ in calls]
    try:
        for index, (worker, call) in enumerate(zip(workers, calls, strict=True)):
            worker.call(call, hear=functools.partial(reported.__setitem__, index))
        while len(results) < len(calls):
            left = [index for index in range(len(calls)) if index not in results]
            ready = wait([workers[index].connection for index in left])
            for index in left:
                if workers[index].connection not in ready:
                    continue
                answer = workers[index].receive()
                if isinstance(answer, Failure):
                    raise answer.as_error(what)
                if answer is not None:
                    results[index] = cast(T, answer.value)
            hear(reported)
        for worker in workers:
            worker.dismiss()
    except Died as death:
        raise SurgicaiError(
            f"A process of {what} was killed (exit code {death.exit_code}; out of memory?); "
            "run it again with --workers 1."
        ) from None
    finally:
        for worker in workers:
            worker.end()
    return [results[index] for index in range(len(calls))]


def start_module(
    module: str, *arguments: str, variables: Mapping[str, str] = ONE_THREAD
) -> "subprocess.Popen[str]":
    """Start `python -m module arguments…`, which ends with this process; its output is captured."""
    return subprocess.Popen(
        _command(module, arguments),
        env={**os.environ, **variables},
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def run_module(
    module: str,
    *arguments: str,
    variables: Mapping[str, str] = ONE_THREAD,
    timeout: float | None = None,
) -> "subprocess.CompletedProcess[str]":
    """Run `python -m module arguments…` to its end and return its exit code and output.

    Raises:
        subprocess.TimeoutExpired: it took longer than `timeout` [s] and was killed.
    """
    with start_module(module, *arguments, variables=variables) as process:
        try:
            output, complaint = process.communicate(timeout=timeout)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(process.args, process.returncode, output, complaint)


_PROGRAM = "from surgicai_vision.core.processes import run_as_child; run_as_child()"


def _command(module: str, arguments: Sequence[str]) -> list[str]:
    return [sys.executable, "-c", _PROGRAM, str(os.getpid()), module, *arguments]


def run_as_child() -> None:
    """Run the module that the command line names; the whole program of `start_module`."""
    _, parent, module, *arguments = sys.argv
    end_with_parent(int(parent))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
