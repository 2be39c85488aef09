"""A clock for tests: it advances only on command."""


class Clock:
    """A clock that advances only on command."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        assert seconds > 0
        self.now += seconds
