"""The program `surgicai-vision`, and `python -m surgicai_vision`.

The command line is imported inside `main`: the import takes a second, during which Ctrl-C must also
print one line, as it does later (`commands.main`).
"""

import os
import signal
import sys
from types import FrameType

from surgicai_vision.core.errors import INTERRUPTED
from surgicai_vision.core.plugins import DISTRIBUTION, resolve


def main() -> int:
    """Run one command and return its exit code."""
    is_heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_heard:  # else whoever started the program wants Ctrl-C ignored
        signal.signal(signal.SIGINT, _leave)
    run = resolve("surgicai_vision.commands.main:main")
    if is_heard:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return int(run())


def _leave(number: int, frame: FrameType | None) -> None:
    """End at once: no work has begun, and an import might not let an exception through."""
    print(f"{DISTRIBUTION}: {INTERRUPTED}", file=sys.stderr, flush=True)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
