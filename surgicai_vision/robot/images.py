"""Images: what the cameras of a served simulation publish, without holding up its control.

In real time images are rendered in a thread with an env of its own, from states it is offered; when
rendering is slower than the rate, states are left out, and control goes on. Where the client sets
the clock they are rendered at once, each step. An image bears the stamp of the state it shows.
A view that nobody hears is not rendered.
"""

import io
import threading
from collections.abc import Callable, Mapping
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


@final
class Cameras:
    """Renders and publishes the views of one env.

    Args:
        env: the env.
        views: its cameras and crops.
        size: height and width of an image [pixel].
        is_compressed: publish JPEG files besides.
        publisher: returns what publishes on a topic.
        is_heard: returns whether somebody hears a topic.
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
        height, width = self._size
        for view, publish in self._raw.items():
            header = Header(stamp, optical_frame(view))
            is_raw = self._is_heard(image_topic(view))
            is_small = view in self._small and self._is_heard(compressed_topic(view))
            if is_raw or is_small:
                frame = self._env.image(view, self._size).astype(np.uint8, copy=False)
                if is_raw:
                    publish(Image(header, height, width, frame.tobytes()))
                if is_small:
                    self._small[view](CompressedImage(header, "jpeg", _jpeg(frame)))
            intrinsics = self._env.calibration.intrinsics(view, self._size)
            self._infos[view](CameraInfo(header, height, width, tuple(intrinsics.ravel().tolist())))


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
        self._offer: tuple[State, int] | None = None
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
        """Return True if a state that is offered now is rendered at once."""
        with self._changed:
            return self._offer is None

    def offer(self, state: State, stamp: int) -> None:
        """Show a state of the env's `get_state` next, in the place of one that still waits.

        Raises:
            Exception: whatever ended the thread.
        """
        with self._changed:
            if self._error is not None:
                raise self._error
            self._offer = (state, stamp)
            self._changed.notify()

    def _run(self) -> None:
        try:
            self._render()
        except Exception as error:  # it belongs to the thread that offers states
            with self._changed:
                self._error = error
                self._offer = None

    def _render(self) -> None:
        env = envs.make(self._config)
        cameras = self._make(env)
        while True:
            with self._changed:
                while self._offer is None and not self._is_over:
                    self._changed.wait()
                if self._is_over:
                    break
                offer = self._offer
            assert offer is not None
            state, stamp = offer
            env.set_state_vector(state)
            cameras.publish(stamp)
            with self._changed:
                if self._offer is offer:
                    self._offer = None
        env.close()


def _jpeg(frame: NDArray[np.uint8]) -> bytes:
    """Return an image (height, width, 3) as a JPEG file."""
    file = io.BytesIO()
    Pillow.fromarray(frame).save(file, "JPEG", quality=JPEG_QUALITY)
    return file.getvalue()
