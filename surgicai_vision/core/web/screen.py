"""Screen: the newest images and status, passed from the working thread to a server's threads."""

import dataclasses
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

POLL_S = 1.0
"""Longest time that a request for the next status waits [s]."""
JPEG_QUALITY = 85

Images = Mapping[str, NDArray[np.uint8]]
"""View → image (height, width, 3)."""


class PageScreen:
    """The newest images and status of what pages show.

    Images that are the same object as before keep their number, and a page does not fetch them
    again.

    Attributes:
        watched: a page has requested the status.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.watched = False
        self._number = 0
        self._image_number = 0
        self._requested = False
        self._images: Images = {}
        self._encoded: dict[str, bytes] = {}
        self._status: dict[str, object] = {}

    def wants_image(self) -> bool:
        """Return True if a page waits for an image."""
        return self._requested

    def show(self, images: Images, status: "DataclassInstance") -> None:
        """Offer new images to the pages."""
        with self._changed:
            self._number += 1
            if images is not self._images:
                self._image_number += 1
                self._images = images
                self._encoded = {}
            self._requested = False
            self._status = dataclasses.asdict(status)
            self._changed.notify_all()

    def status(self, after: int) -> dict[str, object]:
        """Return the newest status with its number, waiting a while for one after `after`."""
        with self._changed:
            self.watched = True
            if self._number <= after:
                self._requested = True
                self._changed.wait_for(lambda: self._number > after, POLL_S)
            return {**self._status, "number": self._number, "image": self._image_number}

    def jpeg(self, view: str) -> bytes | None:
        """Return the newest image of a view; None where there is none."""
        with self._changed:
            number = self._image_number
            image = self._images.get(view)
            encoded = self._encoded.get(view)
        if encoded is not None or image is None:
            return encoded
        # Outside the lock: the session's thread must not wait for it.
        done, data = cv2.imencode(
            ".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        )
        encoded = data.tobytes() if done else b""
        with self._changed:
            if number == self._image_number:
                self._encoded[view] = encoded
        return encoded
