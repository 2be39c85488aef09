"""Images: what the cameras of a served simulation publish, without delaying its control.

In real time, images are rendered in a thread with its own env. A control step is computed at its
beginning, so the resulting state is offered to the thread ahead of time. Its images are published
as soon as it is the present state. If rendering is slower than the rate, states are skipped and
control continues. If the client sets the clock, images are rendered immediately at each step. An
image has the stamp of the state it shows. A view without a listener is not rendered.
"""

import io
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.robot.messages import CameraInfo, CompressedImage, Header, Image
from surgicai_vision.robot.topics import Topic, compressed_topic, image_topic, info_topic
from surgicai_vision.robot.transport import Publish

JPEG_QUALITY = 95
State = NDArray[np.float64]


def optical_frame(view: str) -> str:
    """Return the name of a view's optical frame: x right, y down, z forward."""
    return f"{view}_optical_frame"


@dataclass(frozen=True)
class Shot:
    """One view of one state, as it will be published.

    Attributes:
        view: the camera or crop.
        intrinsics: its camera matrix, row by row [pixel].
        raw: the image's bytes, height × width × 3; None without a listener.
        jpeg: the image as a JPEG file; None without a listener.
    """

    view: str
    intrinsics: tuple[float, ...]
    raw: bytes | None
    jpeg: bytes | None


@dataclass
class _Offer:
    """A state to be shown, and its stamp once it is the present one [ns]."""

    state: State
    stamp: int | None = None


@final
class Cameras:
    """Renders and publishes the views of one env.

    Args:
        env: the env.
        views: its cameras and crops.
        size: height and width of an image [pixel].
        is_compressed: also publish JPEG files.
        publisher: returns a function that publishes on a topic.
        is_heard: returns whether a topic has a listener.
    """

    def __init__(
        self,
        env: SuturingEnv,
        views: tuple[str, ...],
        size: tuple[int, int],
        is_compressed: bool,
        publisher: Callable[[Topic], Publish],
        is_heard: Callable[[Topic], bool],
    ):
        self._env = env
        self._size = size
        self._is_heard = is_heard
        self._raw = {view: publisher(image_topic(view)) for view in views}
        self._infos = {view: publisher(info_topic(view)) for view in views}
        self._small: Mapping[str, Publish] = (
            {view: publisher(compressed_topic(view)) for view in views} if is_compressed else {}
        )

    def publish(self, stamp: int) -> None:
        """Render the env's present state and publish every view with `stamp` [ns]."""
        self.publish_shots(self.render(), stamp)

    def render(self) -> list["Shot"]:
        """Render the env's present state in every view."""
        shots = []
        for view in self._raw:
            is_raw = self._is_heard(image_topic(view))
            is_small = view in self._small and self._is_heard(compressed_topic(view))
            frame = None
            if is_raw or is_small:
                frame = self._env.image(view, self._size).astype(np.uint8, copy=False)
            intrinsics = self._env.calibration.intrinsics(view, self._size)
            shots.append(
                Shot(
                    view,
                    tuple(intrinsics.ravel().tolist()),
                    None if frame is None or not is_raw else frame.tobytes(),
                    None if frame is None or not is_small else _jpeg(frame),
                )
            )
        return shots

    def publish_shots(self, shots: list["Shot"], stamp: int) -> None:
        """Publish what `render` returned with the stamp of its state [ns]."""
        height, width = self._size
        for shot in shots:
            header = Header(stamp, optical_frame(shot.view))
            if shot.raw is not None:
                self._raw[shot.view](Image(header, height, width, shot.raw))
            if shot.jpeg is not None:
                self._small[shot.view](CompressedImage(header, "jpeg", shot.jpeg))
            self._infos[shot.view](CameraInfo(header, height, width, shot.intrinsics))


@final
class ImageThread:
    """Publishes images in a thread; a context manager.

    Args:
        config: the task whose states are shown.
        make: makes the cameras of an env.
    """

    def __init__(self, config: TaskConfig, make: Callable[[SuturingEnv], Cameras]):
        self._config = config
        self._make = make
        self._changed = threading.Condition()
        self._next: _Offer | None = None
        self._newest: _Offer | None = None
        self._error: Exception | None = None
        self._is_over = False
        self._thread = threading.Thread(target=self._run, name="images", daemon=True)

    def __enter__(self) -> "ImageThread":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._is_over = True
            self._changed.notify()
        self._thread.join()

    @property
    def is_free(self) -> bool:
        """Return True if no state that was offered still waits to be rendered."""
        with self._changed:
            return self._next is None

    def offer(self, state: State) -> None:
        """Render a state from the env's `get_state` next, instead of one that is still waiting.

        Raises:
            Exception: whatever ended the thread.
        """
        with self._changed:
            if self._error is not None:
                raise self._error
            self._next = self._newest = _Offer(state)
            self._changed.notify()

    def release(self, stamp: int) -> None:
        """Publish the state that was offered last, now the present one, with `stamp` [ns].

        Nothing is done if it was released before.
        """
        with self._changed:
            if self._newest is not None and self._newest.stamp is None:
                self._newest.stamp = stamp
                self._changed.notify()

    def _run(self) -> None:
        try:
            self._render()
        except Exception as error:  # the thread that offers states raises it
            with self._changed:
                self._error = error
                self._next = None

    def _render(self) -> None:
        env = envs.make(self._config)
        cameras = self._make(env)
        while (offer := self._take()) is not None:
            env.set_state_vector(offer.state)
            shots = cameras.render()
            stamp = self._stamp_of(offer)
            if stamp is not None:
                cameras.publish_shots(shots, stamp)
        env.close()

    def _take(self) -> _Offer | None:
        """Wait for an offer and take it; None if the thread is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._next is not None or self._is_over)
            offer, self._next = self._next, None
            return None if self._is_over else offer

    def _stamp_of(self, offer: _Offer) -> int | None:
        """Wait for an offer's stamp; None at the end, or if a reset replaced the offer."""
        with self._changed:
            self._changed.wait_for(
                lambda: offer.stamp is not None or offer is not self._newest or self._is_over
            )
            return offer.stamp


def _jpeg(frame: NDArray[np.uint8]) -> bytes:
    """Return an image (height, width, 3) as a JPEG file."""
    file = io.BytesIO()
    Pillow.fromarray(frame).save(file, "JPEG", quality=JPEG_QUALITY)
    return file.getvalue()
