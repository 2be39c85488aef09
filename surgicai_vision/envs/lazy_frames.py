"""Lazy frames: images of an observation that are rendered when they are first looked at.

A policy over several others sees two of eight views in most steps; an observation of this kind
costs what is looked at. It is a mapping like any observation with images, with the same pixels.
What was looked at stays; what was not is refused once the env has moved on.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from surgicai_vision.scene.rendering import Frame


@final
class LazyFrames(Mapping[str, "Frame"]):
    """Frames by key, each made once.

    Args:
        makers: key → what makes its frame, when it is first asked for.
        ready: frames that are there already.
    """

    def __init__(
        self, makers: Mapping[str, Callable[[], "Frame"]], ready: Mapping[str, "Frame"]
    ) -> None:
        self._makers = makers
        self._frames = dict(ready)

    def __getitem__(self, key: str) -> "Frame":
        """Return a frame; it is made now if it is asked for the first time."""
        if key not in self._frames:
            self._frames[key] = self._makers[key]()
        return self._frames[key]

    def __iter__(self) -> Iterator[str]:
        """Yield the keys; none of their frames is made."""
        return iter({**self._makers, **self._frames})

    def __len__(self) -> int:
        """Return the number of keys."""
        return len({**self._makers, **self._frames})

    def __contains__(self, key: object) -> bool:
        """Return True for a key, whose frame is not made."""
        return key in self._makers or key in self._frames
