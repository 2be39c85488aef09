"""Server: a site on this machine's loopback, behind a token.

Addresses below `http://127.0.0.1:PORT/TOKEN/` serve what a `Site` answers; `POST input` takes JSON.

Without the random token every answer is 404; a page of another site that knows the port is refused
by its Host (DNS rebinding) and its Origin. Pages load nothing from elsewhere.
"""

import json
import secrets
import socket
import threading
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Protocol
from urllib.parse import urlsplit

from surgicai_vision.core.errors import InputError

HOST = "127.0.0.1"
HOST_NAMES = ("127.0.0.1", "localhost")
"""Names under which a browser, here or at the end of a tunnel, may address the server."""
MAX_INPUT_BYTES = 4096
"""Largest size of an input [byte]."""
KINDS = MappingProxyType({".js": "text/javascript", ".css": "text/css"})
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

type Content = tuple[bytes, str]
"""The content of an address, and its type."""


class Site(Protocol):
    """What a server serves; its methods are called by the server's threads."""

    def answer(self, path: str, query: str) -> Content | None:
        """Return the content of an address below the token, or None."""

    def receive(self, content: object) -> None:
        """Take an input, decoded JSON; raise `InputError` if it is invalid."""


class PageServer:
    """Serves a site from its own threads, from `start` to `stop`.

    Args:
        site: what it serves.
        port: port to listen on; 0 takes any free port.

    Raises:
        InputError: the port is not free.
    """

    def __init__(self, site: Site, port: int = 0):
        self.token = secrets.token_urlsafe(16)
        try:
            self._server = _Server(port, site, self.token)
        except (OSError, OverflowError) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or error
            raise InputError(
                f"--port {port} is not free ({reason}); give another, or 0 for any."
            ) from None
        self.address, self.port = self._server.server_address[:2]
        self.url = f"http://{HOST}:{self.port}/{self.token}/"
        self.invitation = (
            f"Open {self.url}",
            f"From another machine: ssh -L {self.port}:{HOST}:{self.port} THIS-MACHINE, "
            "then open the same address there.",
        )

    def start(self) -> None:
        """Begin to serve."""
        threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        ).start()

    def stop(self) -> None:
        """Stop serving and free the port."""
        self._server.shutdown()
        self._server.server_close()


def page_file(path: Path) -> Content:
    """Return a script or a style sheet that a page loads."""
    return path.read_bytes(), f"{KINDS[path.suffix]}; charset=utf-8"


class _Server(ThreadingHTTPServer):
    """A server on loopback whose handlers know the site."""

    daemon_threads = True

    def __init__(self, port: int, site: Site, token: str):
        self.site = site
        self.token = token.encode()
        super().__init__((HOST, port), _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Print nothing: a browser that disconnects is not an error."""


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
        found = self.server.site.answer(path, urlsplit(self.path).query)
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
            self.server.site.receive(json.loads(body))
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
        if not (secrets.compare_digest(token.encode(), self.server.token) and slash):
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
        """Return the name without a version."""
        return "surgicai-vision"


def _host_name(address: str) -> str | None:
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None
