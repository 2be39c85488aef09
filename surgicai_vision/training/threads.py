"""Threads of torch."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute with one thread.

    Sums then keep their order on any machine, and processes share the cores. For networks as small
    as ours, threads cost more than they save: seventeen times more on busy cores.
    """
    import torch  # not at the top: commands that only name a policy start without it

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
