"""Web: the page that shows the images and takes a browser's keys, touches and gamepads.

`core.web` serves it: `POST input` carries what is held and what was pressed (`PageInputs.receive`).
The keys of a browser that is silent for half a second count as released.
"""

import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path

from surgicai_vision.core.errors import InputError
from surgicai_vision.core.web.screen import PageScreen
from surgicai_vision.core.web.site import ScreenPage, ScreenSite, render_page
from surgicai_vision.teleoperation.gamepad import Gamepad
from surgicai_vision.teleoperation.inputs import Input, merge
from surgicai_vision.teleoperation.keyboard import TABLE, Keyboard, key_names

SILENCE_S = 0.5
"""Time without a message after which a browser's keys count as released [s]."""
MAX_PAGES = 8
"""How many pages open at the same time have inputs that count."""
FOLDER = Path(__file__).parent / "page"


@dataclasses.dataclass
class _Page:
    """The inputs of one open page.

    Attributes:
        keyboard: its keys.
        gamepad: its gamepad.
        number: number of its last message.
        received: when that was received [s].
    """

    keyboard: Keyboard
    gamepad: Gamepad
    number: int = -1
    received: float = 0.0


@dataclasses.dataclass(frozen=True)
class _Message:
    """What a page sends: its keys, its gamepad, and an increasing number."""

    client: str
    number: int
    held: list[str]
    pressed: list[str]
    axes: list[float]
    buttons: list[float]


class PageInputs:
    """The inputs of all open pages; a `Device` that server threads feed.

    Args:
        clock: returns monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._lock = threading.Lock()
        self._pages: dict[str, _Page] = {}

    def receive(self, content: object) -> None:
        """Take a page's message.

        Args:
            content: {"client": str, "number": int, "held": [code], "pressed": [code], "axes":
                [float], "buttons": [float]}; "pressed" keys went down since the previous message.
                Older numbers are ignored.

        Raises:
            InputError: anything else.
        """
        message = _read_message(content)
        with self._lock:
            page = self._pages.get(message.client) or self._add_page(message.client)
            if message.number <= page.number:
                return
            page.number = message.number
            page.received = self._clock()
            for code in message.pressed:
                page.keyboard.release(code)
                page.keyboard.press(code)
            page.keyboard.hold(message.held)
            page.gamepad.update(message.axes, message.buttons)

    def poll(self) -> Input:
        """Return the current input of all pages."""
        with self._lock:
            for page in self._pages.values():
                if self._clock() - page.received > SILENCE_S:
                    page.keyboard.release_all()
                    page.gamepad.release_all()
            return merge(
                device.poll()
                for page in self._pages.values()
                for device in (page.keyboard, page.gamepad)
            )

    def _add_page(self, client: str) -> _Page:
        """Add a page; where there are too many, the one silent for longest is dropped."""
        if len(self._pages) >= MAX_PAGES:
            del self._pages[min(self._pages, key=lambda name: self._pages[name].received)]
        self._pages[client] = _Page(Keyboard(), Gamepad())
        return self._pages[client]


def _read_message(content: object) -> _Message:
    """Return a checked message, or raise `InputError`."""
    if not isinstance(content, dict):
        raise InputError("An input must be a table.")
    client = content.get("client")
    number = content.get("number")
    texts = [content.get(name, []) for name in ("held", "pressed")]
    numbers = [content.get(name, []) for name in ("axes", "buttons")]
    if not (
        isinstance(client, str)
        and len(client) <= 64
        and isinstance(number, int)
        and all(isinstance(row, list) and len(row) <= 64 for row in (*texts, *numbers))
        and all(isinstance(code, str) for row in texts for code in row)
        and all(isinstance(value, (int, float)) for row in numbers for value in row)
        and all(-2 < value < 2 for row in numbers for value in row)
    ):
        raise InputError("An input must have client, number, held, pressed, axes and buttons.")
    return _Message(client, number, *texts, *numbers)


class WebView(ScreenPage):
    """The page's server; a `Device` and a `Screen`. Use it as a context manager.

    Args:
        views: the cameras shown.
        title: what the page is about.
        port: to listen on; 0 takes any.

    Raises:
        InputError: the port is not free.
    """

    def __init__(self, views: tuple[str, ...], title: str, port: int = 0):
        self.inputs = PageInputs()
        screen = PageScreen()
        html = render_page(
            FOLDER / "page.html.j2", views=views, title=title, rows=TABLE, key_names=key_names
        )
        files = {name: FOLDER / name for name in ("page.js", "page.css")}
        site = ScreenSite(html, files, screen, self.inputs.receive)
        super().__init__(site, port)
        self.wants_image = self.screen.wants_image
        self.show = self.screen.show
        self.poll = self.inputs.poll
