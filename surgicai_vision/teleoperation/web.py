"""Web: the page that shows the images and takes a browser's keys, touches and gamepads.

`http://127.0.0.1:PORT/TOKEN/` and below it:

    GET  .                  the page; page.js and page.css beside it
    GET  status?after=N     JSON: the session's status and the number of the newest images; waits
                            for a status after N
    GET  view/NAME.jpg      the newest image of a view
    POST input              JSON: what is held and what was pressed (`PageInputs.receive`)

The server listens on loopback only. Without the random token every answer is 404; a page of another
site that knows the port is refused by its Host (DNS rebinding) and its Origin. The keys of a
browser that is silent for half a second count as released.
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
from urllib.parse import parse_qs, urlsplit

import cv2
import jinja2

from surgicai_vision.core.errors import InputError
from surgicai_vision.teleoperation.gamepad import Gamepad
from surgicai_vision.teleoperation.inputs import Input, merge
from surgicai_vision.teleoperation.keyboard import TABLE, Keyboard, key_names
from surgicai_vision.teleoperation.loop import Images
from surgicai_vision.teleoperation.session import Status

HOST = "127.0.0.1"
HOST_NAMES = ("127.0.0.1", "localhost")
"""Names under which a browser, here or at the end of a tunnel, may address the server."""
SILENCE_S = 0.5
"""Time without a message after which a browser's keys count as released [s]."""
MAX_PAGES = 8
"""Pages open at the same time whose inputs count."""
POLL_S = 1.0
"""Time that a request for the next status waits at most [s]."""
MAX_INPUT_BYTES = 4096
"""Size of an input, at most [byte]."""
JPEG_QUALITY = 85
FOLDER = Path(__file__).parent / "page"
FILES = MappingProxyType({"page.js": "text/javascript", "page.css": "text/css"})
HEADERS = MappingProxyType(
    {
        "Cache-Control": "no-store",
        "Content-Security-Policy": (
            "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'"
        ),
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
    }
)


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
    """What a page sends: its keys, its gamepad, and a number that grows."""

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
                [float], "buttons": [float]}; "pressed" went down since the message before. Older
                numbers are ignored.

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
        """Return the present input of all pages."""
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


class PageScreen:
    """The newest images and status, passed from the session's thread to the server's; a `Screen`.

    Images that are the same object as before keep their number, and a page does not fetch them
    again.
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

    def show(self, images: Images, status: Status) -> None:
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
        self.inputs = PageInputs()
        self.screen = PageScreen()
        self.token = secrets.token_urlsafe(16)
        self._page = _page(views, title)
        try:
            self._server = _Server(port, self)
        except (OSError, OverflowError) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or error
            raise InputError(
                f"--port {port} is not free ({reason}); give another, or 0 for any."
            ) from None
        self.port = self._server.server_address[1]
        self.url = f"http://{HOST}:{self.port}/{self.token}/"
        self.invitation = (
            f"Open {self.url}",
            f"From another machine: ssh -L {self.port}:{HOST}:{self.port} THIS-MACHINE, "
            "then open the same there.",
        )
        self.wants_image = self.screen.wants_image
        self.show = self.screen.show
        self.poll = self.inputs.poll

    def __enter__(self) -> "WebView":
        threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        ).start()
        return self

    def __exit__(self, *_: object) -> None:
        """Let open pages fetch the last status, then shut the server down."""
        if self.screen.watched:
            time.sleep(0.5)
        self._server.shutdown()
        self._server.server_close()

    def answer(self, path: str, query: str) -> tuple[bytes, str] | None:
        """Return the content of an address below the token and its type, or None."""
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

    def handle_error(self, request: object, client_address: object) -> None:
        """Print nothing: a browser that leaves is no error."""


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
        """Answer with the content of an address."""
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
        if not length.isdecimal() or int(length) > MAX_INPUT_BYTES:
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
            self.server.web.inputs.receive(json.loads(body))
        except (InputError, ValueError, RecursionError):
            self._refuse(HTTPStatus.BAD_REQUEST)
            return
        self._send(HTTPStatus.NO_CONTENT, b"", "application/json")

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the console is the session's, and addresses contain the token."""

    def _path(self) -> str | None:
        """Return the path below the token, or refuse the request and return None."""
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        if _host_name(f"//{host}") not in HOST_NAMES or (
            origin is not None and origin != f"http://{host}"
        ):
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
        """Return no version."""
        return "surgicai-vision"


def _host_name(address: str) -> str | None:
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None


def _page(views: tuple[str, ...], title: str) -> bytes:
    """Return the page."""
    loader = jinja2.FileSystemLoader(FOLDER)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined
    )
    template = environment.get_template("page.html.j2")
    return template.render(views=views, title=title, rows=TABLE, key_names=key_names).encode()
