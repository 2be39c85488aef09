"""Progress for tests: a stage that passes its reports to a function."""

from contextlib import contextmanager


def showing(progress):
    """Return a stage that reports to the function `progress`."""

    @contextmanager
    def stage(title, unit=""):
        yield progress

    return stage
