"""Lazy mapping: values that are computed on first access, such as rendered images.

A policy over several others reads two of eight views in most steps; with such an observation it
pays only for those.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import final


@final
class LazyMapping[T](Mapping[str, T]):
    """Values by key, each computed once and then kept.

    Args:
        makers: key → function that computes its value, called on first access.
        ready: values that exist already.
    """

    def __init__(self, makers: Mapping[str, Callable[[], T]], ready: Mapping[str, T]) -> None:
        self._makers = makers
        self._values = dict(ready)

    def __getitem__(self, key: str) -> T:
        """Return a value; compute it on first access."""
        if key not in self._values:
            self._values[key] = self._makers[key]()
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        """Yield the keys, without computing values."""
        return iter({**self._makers, **self._values})

    def __len__(self) -> int:
        """Return the number of keys."""
        return len({**self._makers, **self._values})

    def __contains__(self, key: object) -> bool:
        """Return True for a key, without computing its value."""
        return key in self._makers or key in self._values
