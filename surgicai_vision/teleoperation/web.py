"""Web: the page that shows the images and takes keys, touches and gamepads of the browser that
looks at it.

`http://127.0.0.1:PORT/TOKEN/` and below it:

    GET  .                  the page; page.js and page.css beside it
    GET  status?after=N     JSON: what the session says, and the number of the newest images; waits
    for one after N GET  view/NAME.jpg      the newest image of a view
    POST input              JSON: what is held and what was pressed (`Hands.receive`)

The server listens on loopback alone. Whoever lacks the random token gets 404 and learns nothing; a
page of another site that knows the port is refused by its Host (DNS rebinding) and its Origin. A
browser that falls silent for half a second holds nothing any more.
"""

import dataclasses
import json
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2

from surgicai_vision.core.errors import InputError
from surgicai_vision.teleoperation.gamepad import Gamepad
from surgicai_vision.teleoperation.inputs import Input, merged
from surgicai_vision.teleoperation.keyboard import TABLE, Keyboard, key_names
from surgicai_vision.teleoperation.loop import Images
from surgicai_vision.teleoperation.session import Status

HOST = "127.0.0.1"
NAMES = ("127.0.0.1", "localhost")
"""What a browser on this machine, or at the end of a tunnel, may call the server."""
SILENT = 0.5
"""Seconds without a word after which a browser's keys count as released."""
BROWSERS = 8
"""Pages open at the same time whose hands are known."""
PATIENCE = 1.0
"""Seconds that a request for the next images waits at most."""
LONGEST = 4096
"""Bytes of an input, at most."""
QUALITY = 85
"""Of the JPEGs."""
FOLDER = Path(__file__).parent / "page"
FILES = MappingProxyType({"page.js": "text/javascript", "page.css": "text/css"})
HEADERS = MappingProxyType(
    {
        "Cache-Control": "no-store",
        "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
    }
)


@dataclasses.dataclass
class _Browser:
    """The hands at one open page: its keys, its gamepad, the number of its last message and when
    that came.
    """

    keyboard: Keyboard
    gamepad: Gamepad
    number: int = -1
    heard: float = 0.0


class Hands:
    """The hands at all open pages; a `Device` that server threads feed.

    Args:
        clock: seconds, monotonic.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock, self._lock = clock, threading.Lock()
        self._browsers: dict[str, _Browser] = {}

    def receive(self, message: Any) -> None:
        """Take a page's message.

        Args:
            message: {"client": str, "number": int, "held": [code], "pressed": [code], "axes":
                [float], "buttons": [float]}; "pressed" went down since the message before. Older
                numbers are passed over.

        Raises:
            InputError: anything else.
        """
        client, number, held, pressed, axes, buttons = _checked(message)
        with self._lock:
            browser = self._browsers.get(client) or self._welcome(client)
            if number <= browser.number:
                return
            browser.number, browser.heard = number, self._clock()
            for code in pressed:
                browser.keyboard.release(code)
                browser.keyboard.press(code)
            browser.keyboard.hold(held)
            browser.gamepad.update(axes, buttons)

    def poll(self) -> Input:
        """Return what all of them do now."""
        with self._lock:
            for browser in self._browsers.values():
                if self._clock() - browser.heard > SILENT:
                    browser.keyboard.release_all()
                    browser.gamepad.release_all()
            return merged(
                device.poll()
                for browser in self._browsers.values()
                for device in (browser.keyboard, browser.gamepad)
            )

    def _welcome(self, client: str) -> _Browser:
        """Know one more page; the one silent for longest makes room."""
        if len(self._browsers) >= BROWSERS:
            del self._browsers[min(self._browsers, key=lambda name: self._browsers[name].heard)]
        self._browsers[client] = _Browser(Keyboard(), Gamepad())
        return self._browsers[client]


def _checked(message: Any) -> tuple[str, int, list[str], list[str], list[float], list[float]]:
    """Return the parts of a message, or raise `InputError`."""
    if not isinstance(message, dict):
        raise InputError("An input must be a table.")
    client, number = message.get("client"), message.get("number")
    texts = [message.get(name, []) for name in ("held", "pressed")]
    numbers = [message.get(name, []) for name in ("axes", "buttons")]
    fine = isinstance(client, str) and len(client) <= 64 and isinstance(number, int)
    fine = fine and all(isinstance(row, list) and len(row) <= 64 for row in (*texts, *numbers))
    fine = fine and all(isinstance(code, str) for row in texts for code in row)
    fine = fine and all(
        isinstance(value, (int, float)) and -2 < value < 2 for row in numbers for value in row
    )
    if not fine:
        raise InputError("An input must have client, number, held, pressed, axes and buttons.")
    return str(client), int(number or 0), *texts, *numbers


class Show:
    """The newest images and status, handed from the session's thread to the server's; a `Screen`.

    An image that is the one before, the very object, keeps its number, and a page does not fetch it
    again.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number, self._image, self._asked, self.watched = 0, 0, False, False
        self._images: Images = {}
        self._encoded: dict[str, bytes] = {}
        self._status: dict[str, Any] = {}

    def wants(self) -> bool:
        """Say whether a page waits for an image."""
        return self._asked

    def show(self, images: Images, status: Status) -> None:
        """Offer new images to whoever waits."""
        with self._changed:
            self._number += 1
            if images is not self._images:
                self._image += 1
                self._images, self._encoded = images, {}
            self._asked = False
            self._status = dataclasses.asdict(status)
            self._changed.notify_all()

    def status(self, after: int) -> dict[str, Any]:
        """Return the newest status with its number, a newer one than `after` if it comes in
        time.
        """
        with self._changed:
            self.watched = True
            if self._number <= after:
                self._asked = True
                self._changed.wait_for(lambda: self._number > after, PATIENCE)
            return {**self._status, "number": self._number, "image": self._image}

    def jpeg(self, view: str) -> bytes | None:
        """Return the newest image of a view; None where there is none."""
        with self._changed:
            number, image, known = self._image, self._images.get(view), self._encoded.get(view)
        if known is not None or image is None:
            return known
        # Outside the lock: the session's thread must not wait for it.
        done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        encoded = data.tobytes() if done else b""
        with self._changed:
            if number == self._image:
                self._encoded[view] = encoded
        return encoded


class WebView:
    """The page's server; a `Device` and a `Screen`. Use it as a context manager.

    Args:
        views: the cameras shown.
        title: what the page is about.
        port: to listen at; 0 takes any.

    Raises:
        InputError: the port is not free.
    """

    def __init__(self, views: tuple[str, ...], title: str, port: int = 0):
        self.hands, self.screen = Hands(), Show()
        self.token = secrets.token_urlsafe(16)
        self._page = _page(views, title)
        try:
            self._server = _Server(port, self)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(
                f"--port {port} is not free ({reason}); give another, or 0 for any."
            ) from None
        self.port = self._server.server_address[1]
        self.url = f"http://{HOST}:{self.port}/{self.token}/"
        self.invitation = (
            f"Open {self.url}",
            f"From another machine: ssh -L {self.port}:{HOST}:{self.port} THIS-MACHINE, then open the same there.",
        )
        self.wants, self.show, self.poll = self.screen.wants, self.screen.show, self.hands.poll

    def __enter__(self) -> "WebView":
        threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        ).start()
        return self

    def __exit__(self, *_: object) -> None:
        """Let open pages hear the last word, then shut the server."""
        if self.screen.watched:
            time.sleep(0.5)
        self._server.shutdown()
        self._server.server_close()

    def answer(self, path: str, query: str) -> tuple[bytes, str] | None:
        """Return the content of an address below the token, and its type; None where there is
        nothing.
        """
        if path == "":
            return self._page, "text/html; charset=utf-8"
        if path == "status":
            after = parse_qs(query).get("after", ["0"])[0]
            status = self.screen.status(int(after) if after.isdecimal() else 0)
            return json.dumps(status).encode(), "application/json"
        if path in FILES:
            return (FOLDER / path).read_bytes(), f"{FILES[path]}; charset=utf-8"
        name = path.removeprefix("view/").removesuffix(".jpg")
        image = self.screen.jpeg(name) if path == f"view/{name}.jpg" else None
        return None if image is None else (image, "image/jpeg")


class _Server(ThreadingHTTPServer):
    """A server on loopback whose handlers know the web view."""

    daemon_threads = True

    def __init__(self, port: int, web: WebView):
        self.web = web
        super().__init__((HOST, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser that leaves is no error."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one connection."""

    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = 30

    def setup(self) -> None:
        """Send small answers at once."""
        super().setup()
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)

    def do_GET(self) -> None:
        """Answer with what lies there."""
        path = self._path()
        if path is None:
            return
        found = self.server.web.answer(path, urlsplit(self.path).query)
        if found is None:
            self._refuse(HTTPStatus.NOT_FOUND)
        else:
            self._send(HTTPStatus.OK, *found)

    def do_POST(self) -> None:
        """Take an input."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > LONGEST:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        body = self.rfile.read(int(length))
        path = self._path()
        if path is None:
            return
        if (
            path != "input"
            or self.headers.get("Content-Type", "").split(";")[0] != "application/json"
        ):
            self._refuse(HTTPStatus.NOT_FOUND)
            return
        try:
            self.server.web.hands.receive(json.loads(body))
        except (InputError, ValueError, RecursionError):
            self._refuse(HTTPStatus.BAD_REQUEST)
            return
        self._send(HTTPStatus.NO_CONTENT, b"", "application/json")

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the console is the session's, and addresses hold the token."""

    def _path(self) -> str | None:
        """Return the path below the token; refuse a request that may not ask."""
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        if _name(f"//{host}") not in NAMES or (origin is not None and origin != f"http://{host}"):
            self._refuse(HTTPStatus.FORBIDDEN)
            return None
        token, slash, path = urlsplit(self.path).path.removeprefix("/").partition("/")
        if not (secrets.compare_digest(token.encode(), self.server.web.token.encode()) and slash):
            self._refuse(HTTPStatus.NOT_FOUND)
            return None
        return path

    def _refuse(self, status: HTTPStatus) -> None:
        self.close_connection = True
        self._send(status, f"{status.phrase}\n".encode(), "text/plain")

    def _send(self, status: HTTPStatus, content: bytes, kind: str) -> None:
        self.send_response(status)
        headers: Mapping[str, str] = {
            **HEADERS,
            "Content-Type": kind,
            "Content-Length": str(len(content)),
        }
        for name, value in headers.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def version_string(self) -> str:
        """Return no version: it is nobody's business."""
        return "surgicai-vision"


def _name(address: str) -> str | None:
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None


def _page(views: tuple[str, ...], title: str) -> bytes:
    """Return the page."""
    import jinja2

    loader = jinja2.FileSystemLoader(FOLDER)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined
    )
    template = environment.get_template("page.html.j2")
    return template.render(views=views, title=title, rows=TABLE, key_names=key_names).encode()
