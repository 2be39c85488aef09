"""Senders: telling the senders of one topic apart by the numbers of their messages.

Each sender numbers its messages 1, 2, 3 …; what arrives is a mixture of such rows, each rising,
with gaps where messages were superseded. A message continues the row whose last number is the
highest below its own, and begins another row where there is none: a number that came already, or
an older one, is another sender's.
"""

from typing import final

LARGEST_GAP = 1000
"""Numbers that one sender may leave out; ten seconds of messages that were superseded."""
ROWS = 8
"""Rows that are remembered, the latest."""
UNNUMBERED = 2**63
"""Numbers from which on a middleware says that it has none (rmw/types.h:
RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED is 2⁶⁴ - 1)."""


@final
class Senders:
    """The rows of one topic; see the module's docstring."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._count = 0

    def source(self, number: int | None) -> str:
        """Return the name of the sender of a message, "" where numbers are not given."""
        if number is None or number >= UNNUMBERED:
            return ""
        before = [
            (last, name) for name, last in self._last.items() if 0 < number - last <= LARGEST_GAP
        ]
        name = max(before)[1] if before else self._new()
        self._last.pop(name, None)
        self._last[name] = number
        return name

    def _new(self) -> str:
        """Return the name of another row; the one that is silent for longest is forgotten."""
        if len(self._last) >= ROWS:
            del self._last[next(iter(self._last))]
        self._count += 1
        return f"sender {self._count}"
