"""Senders: distinguishing the senders of one topic by the numbers of their messages.

Each sender numbers its messages 1, 2, 3 …; what arrives is a mixture of such sequences, each
rising, with gaps where messages were superseded. A message continues the sequence whose last number
is the highest below its own. If there is none, it begins a new sequence: a number that came
already, or an older one, is another sender's.
"""

from typing import final

LARGEST_GAP = 1000
"""Most numbers that one sender may skip; ten seconds of superseded messages."""
ROWS = 8
"""Number of sequences that are remembered, the latest ones."""
UNNUMBERED = 2**63
"""Numbers from here on mean that a middleware has none (rmw/types.h:
RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED is 2⁶⁴ - 1)."""


@final
class Senders:
    """The sequences of one topic; see the module's docstring."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._count = 0

    def source(self, number: int | None) -> str:
        """Return the name of the sender of a message, "" if numbers are not given."""
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
        """Return the name of a new sequence; beyond `ROWS`, forget the one silent for longest."""
        if len(self._last) >= ROWS:
            del self._last[next(iter(self._last))]
        self._count += 1
        return f"sender {self._count}"
