"""The documentation site builds without a warning, and a browser shows it without an error."""

import functools
import importlib.util
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser

from surgicai_vision.commands import COMMANDS, dataset

PAGES = (
    "index.html",
    "start.html",
    "evaluation.html",
    "recipes/compare.html",
    "generated/commands/evaluate.html",
    "generated/api/surgicai_vision.envs.html",
    "generated/examples/own_task.html",
)
"""One page of each kind."""
WIDTHS = (1280, 420)
"""Of a desktop's and a phone's window [CSS px]."""


@pytest.fixture(scope="module")
def site(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "--builder", "html", "--fail-on-warning"]
    command += ["--keep-going", "--quiet", "--doctree-dir", str(out / "doctrees")]
    done = subprocess.run(
        [*command, str(root / "docs"), str(out / "html")],
        env={key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return out / "html"


def test_every_verb_has_its_page_with_its_options(site: Path) -> None:
    for verb in COMMANDS:
        assert (site / f"generated/commands/{verb}.html").is_file(), verb
    text = re.sub("<[^>]*>", "", (site / "generated/commands/evaluate.html").read_text("utf-8"))
    assert "--episodes N" in text
    assert "Number of episodes." in text
    text = (site / "generated/commands/dataset.html").read_text(encoding="utf-8")
    assert all(f"dataset-{inner}" in text for inner in dataset.COMMANDS)


def test_the_reference_has_every_package_but_the_commands(site: Path, root: Path) -> None:
    packages = {path.parent.name for path in root.glob("surgicai_vision/*/__init__.py")}
    pages = {path.stem for path in (site / "generated/api").glob("surgicai_vision.*.html")}
    assert pages == {f"surgicai_vision.{name}" for name in packages - {"commands"}}


def test_the_reference_has_what_docstrings_say(site: Path) -> None:
    text = (site / "generated/api/surgicai_vision.evaluation.html").read_text(encoding="utf-8")
    assert 'id="surgicai_vision.evaluation.statistics.mcnemar"' in text
    assert "Psychometrika" in text


def test_names_of_files_and_modules_are_links(site: Path) -> None:
    text = (site / "python.html").read_text(encoding="utf-8")
    assert "generated/api/surgicai_vision.demos.html#surgicai_vision.demos.expert.Expert" in text
    text = (site / "recipes/own_encoder.html").read_text(encoding="utf-8")
    assert "../generated/examples/own_encoder.html" in text


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Where the site is served while tests run."""
    handler = functools.partial(Silent, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


class Silent(SimpleHTTPRequestHandler):
    """Serves files without logging."""

    def log_message(self, format: str, *arguments: object) -> None:
        """Print nothing per request."""


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium")
@pytest.mark.parametrize("width", WIDTHS)
def test_a_browser_shows_it_without_an_error(address: str, tmp_path: Path, width: int) -> None:
    with Browser(tmp_path / "profile", width) as browser:
        metrics = {"width": width, "height": 860, "deviceScaleFactor": 1, "mobile": width < 600}
        browser.call("Emulation.setDeviceMetricsOverride", **metrics)
        for page in PAGES:
            browser.open(address + page)
            assert browser.value("document.querySelector('h1').innerText.length") > 0, page
            assert browser.value("document.documentElement.scrollWidth") <= width, page
            loaded = browser.value("performance.getEntriesByType('resource').map(e => e.name)")
            assert loaded, page
            assert all(name.startswith((address, "data:")) for name in loaded), page
        assert browser.complaints == []


def test_docstrings_become_restructured_text(root: Path) -> None:
    spec = importlib.util.spec_from_file_location("docstrings", root / "docs/site/docstrings.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    given = """\
Return a * b of `x`s, or **arguments.

    code = "`as it is`"

    more(code)

After it:
* one `mcnemar`
  goes on
* two_

Args:
    name: what it
        is

        called.
"""
    wanted = """\
Return a \\* b of ``x``\\ s, or \\*\\*arguments.

::

    code = "`as it is`"

    more(code)

After it:

* one :py:obj:`mcnemar <surgicai_vision.evaluation.statistics.mcnemar>`
  goes on
* two\\_

Args:
    name: what it
        is

        called.
"""
    import surgicai_vision.evaluation.statistics as statistics

    assert module.as_rest(given.split("\n"), statistics.__name__) == wanted.split("\n")
