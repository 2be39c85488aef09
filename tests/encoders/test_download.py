"""Downloads of weights from a local server: resumed, verified, abandoned at once if offline."""

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from huggingface_hub import constants

from encoders import download, weights
from encoders.r3m import CARD
from surgicai_vision.core.errors import BadFile, InputError, MissingWeights
from surgicai_vision.core.files import CACHE_VARIABLE

CONTENT = np.random.default_rng(0).bytes(300_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
OFFLINE = ("imagenet-lite",)
PINNED = replace(CARD, sha256=SHA256, revision="a" * 40)


@dataclass
class Hub:
    """The server's behaviour.

    Attributes:
        cuts: bytes after which each next answer breaks off; later answers are whole.
        ranges: whether it supports range requests.
        content: what it sends.
        asked: the requested paths and ranges.
    """

    cuts: list[int] = field(default_factory=list)
    ranges: bool = True
    content: bytes = CONTENT
    etag: str = SHA256
    asked: list[tuple[str, str]] = field(default_factory=list)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    """A local hub, an empty cache, and no weights folder."""
    state = Hub()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def do_HEAD(self) -> None:
            self.answer(b"", {"ETag": f'"{state.etag}"', "X-Linked-Size": str(len(state.content))})

        def do_GET(self) -> None:
            asked = self.headers.get("Range", "")
            state.asked.append((self.path, asked))
            start = int(asked.removeprefix("bytes=").rstrip("-") or 0) if state.ranges else 0
            body = state.content[start:]
            cut = state.cuts.pop(0) if state.cuts else len(body)
            self.answer(body[:cut], {"Content-Length": str(len(body))}, 206 if start else 200)

        def answer(self, body: bytes, headers: dict[str, str], status: int = 200) -> None:
            self.send_response(status)
            for name, value in ({"X-Repo-Commit": "a" * 40} | headers).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
            self.close_connection = True

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setattr(constants, "is_offline_mode", lambda: False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY", weights.FOLDER_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    weights.hub_answers.cache_clear()
    yield state
    server.shutdown()
    server.server_close()
    weights.hub_answers.cache_clear()


def find(card: Any = PINNED) -> Path:
    path = weights.find(card, None, False, OFFLINE)
    assert path is not None
    return path


def parts(folder: Path) -> list[Path]:
    return [path for path in (folder / "cache").rglob("*") if path.is_file()]


def test_a_file_is_fetched_once_from_its_revision(hub: Hub, tmp_path: Path) -> None:
    path = find()
    assert path.read_bytes() == CONTENT and parts(tmp_path) == [path]
    assert [asked[0] for asked in hub.asked] == [
        f"/{CARD.source}/resolve/{'a' * 40}/{CARD.filename}"
    ]
    assert find() == path and len(hub.asked) == 1
    path.write_bytes(CONTENT[:-1] + b"?")
    with pytest.raises(BadFile, match="damaged"):
        find()


def test_a_transfer_that_breaks_off_goes_on_by_itself(hub: Hub) -> None:
    hub.cuts = [100_000, 50_000]
    assert find().read_bytes() == CONTENT
    assert [asked[1] for asked in hub.asked] == ["bytes=0-", "bytes=100000-", "bytes=150000-"]


def test_another_call_goes_on_where_the_last_one_broke_off(hub: Hub, tmp_path: Path) -> None:
    hub.cuts = [120_000, 0]
    with pytest.raises(
        MissingWeights,
        match=r"120000 of 300000 bytes.*run the same command to resume.*imagenet-lite",
    ):
        find()
    (partial,) = parts(tmp_path)
    assert partial.read_bytes() == CONTENT[:120_000] and partial.suffix == ".partial"
    hub.asked.clear()
    path = find()
    assert (
        hub.asked[0][1] == "bytes=120000-"
        and parts(tmp_path) == [path]
        and path.read_bytes() == CONTENT
    )


def test_a_server_without_ranges_starts_over(hub: Hub) -> None:
    hub.cuts, hub.ranges = [120_000], False
    assert find().read_bytes() == CONTENT


def test_a_file_with_another_hash_is_deleted_and_refused(hub: Hub, tmp_path: Path) -> None:
    hub.content = CONTENT[:-1] + b"?"
    with pytest.raises(BadFile, match=f"expected {SHA256}; it was deleted"):
        find()
    assert parts(tmp_path) == []
    with pytest.raises(
        BadFile, match="it was deleted"
    ):  # an unpinned card takes the hub's own hash
        find(replace(PINNED, sha256=None, revision="main"))
    hub.content = CONTENT
    assert find().read_bytes() == CONTENT


def test_another_version_is_never_glued_to_what_came_before(hub: Hub) -> None:
    unpinned = replace(PINNED, sha256=None, revision="main")
    hub.cuts = [120_000, 0]
    with pytest.raises(MissingWeights):
        find(unpinned)
    hub.content = CONTENT[::-1]
    hub.etag = hashlib.sha256(hub.content).hexdigest()
    assert find(unpinned).read_bytes() == CONTENT[::-1]


def test_two_at_once_fetch_one_file(hub: Hub, tmp_path: Path) -> None:
    found: list[Path] = []
    threads = [threading.Thread(target=lambda: found.append(find())) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 1 and len(found) == 3 and len(hub.asked) == 1


def test_without_a_network_the_alternatives_are_named_at_once(
    hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr(download, "fetch", lambda *_: pytest.fail("the hub does not answer"))
    with pytest.raises(
        MissingWeights, match=r"--weights FILE.*\$SURGICAI_VISION_WEIGHTS.*imagenet-lite"
    ) as caught:
        find()
    assert (
        SHA256 in str(caught.value)
        and parts(tmp_path) == []
        and isinstance(caught.value, InputError)
    )


def test_cards_say_what_is_pinned() -> None:
    from surgicai_vision.features.encoders import encoder_card, encoder_names

    unpinned = {
        name
        for name in encoder_names()
        if not (card := encoder_card(name)).sha256 and card.filename
    }
    assert unpinned == {"r3m-18", "r3m-34", "vc1"}
    assert "unpinned" in weights.missing_line(encoder_card("vc1"), OFFLINE)
