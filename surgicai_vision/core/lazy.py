"""Lazy mapping: values that are made when they are first looked at, such as rendered images.

A policy over several others sees two of eight views in most steps; an observation of this kind
costs what is looked at.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import final


@final
class LazyMapping[T](Mapping[str, T]):
    """Values by key, each made once and then kept.

    Args:
        makers: key → what makes its value, when it is first asked for.
        ready: values that are there already.
    """

    def __init__(self, makers: Mapping[str, Callable[[], T]], ready: Mapping[str, T]) -> None:
        self._makers = makers
        self._values = dict(ready)

    def __getitem__(self, key: str) -> T:
        """Return a value; it is made now if it is asked for the first time."""
        if key not in self._values:
            self._values[key] = self._makers[key]()
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        """Yield the keys; none of their values is made."""
        return iter({**self._makers, **self._values})

    def __len__(self) -> int:
        """Return the number of keys."""
        return len({**self._makers, **self._values})

    def __contains__(self, key: object) -> bool:
        """Return True for a key, whose value is not made."""
        return key in self._makers or key in self._values
