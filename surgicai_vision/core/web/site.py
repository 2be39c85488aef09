"""Site: a page that shows changing images and a changing status.

Below the server's token:

    GET  .                  the page; its scripts and style sheets are next to it
    GET  status?after=N     JSON: the status and the number of the newest images; waits for a status
                            after N
    GET  view/NAME.jpg      the newest image of a view
    POST input              JSON, for `receive`
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self
from urllib.parse import parse_qs

import jinja2

from surgicai_vision.core.web.screen import PageScreen
from surgicai_vision.core.web.server import Content, PageServer, page_file

FOLDER = Path(__file__).parent
SHARED = {name: FOLDER / name for name in ("base.css", "screen.js")}
"""What every such page loads: its style, and the script that fetches images and status."""
LAST_S = 0.5
"""Time that open pages have to fetch the last status [s]."""


@dataclass(frozen=True)
class ScreenSite:
    """One page with a screen; what `PageServer` serves.

    Attributes:
        html: the page.
        files: name → a script or a style sheet next to it; `SHARED` is always included.
        screen: its images and its status.
        receive: takes an input; raises `InputError` if it is invalid.
        answers: address → function that returns its JSON for the number in its query `after`.
    """

    html: bytes
    files: Mapping[str, Path]
    screen: PageScreen
    receive: Callable[[object], None]
    answers: Mapping[str, Callable[[int], object]] = field(default_factory=dict)

    def answer(self, path: str, query: str) -> Content | None:
        """Return the content of an address below the token, or None."""
        if path == "":
            return self.html, "text/html; charset=utf-8"
        files = {**SHARED, **self.files}
        if path in files:
            return page_file(files[path])
        answers = {"status": self.screen.status, **self.answers}
        if path in answers:
            after = parse_qs(query).get("after", ["0"])[0]
            number = int(after) if after.isdecimal() else 0
            return json.dumps(answers[path](number)).encode(), "application/json"
        name = path.removeprefix("view/").removesuffix(".jpg")
        image = self.screen.jpeg(name) if path == f"view/{name}.jpg" else None
        return None if image is None else (image, "image/jpeg")


class ScreenPage:
    """A page while it is served. Use it as a context manager.

    Args:
        site: the page.
        port: port to listen on; 0 takes any free port.

    Raises:
        InputError: the port is not free.
    """

    def __init__(self, site: ScreenSite, port: int):
        self.screen = site.screen
        self.server = PageServer(site, port)

    def __enter__(self) -> Self:
        self.server.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Let open pages fetch the last status, then shut the server down."""
        if self.screen.watched:
            time.sleep(LAST_S)
        self.server.stop()


def render_page(template: Path, **values: object) -> bytes:
    """Return a page from its template; text is escaped, and every value must be given."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template.name).render(**values).encode()
