"""The report: every number and image is there, and the page is self-contained."""

import contextlib
import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pyarrow.parquet as pq
import pytest

from surgicai_vision import report
from surgicai_vision.core import files, names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, SurgicaiError
from surgicai_vision.envs import contact_sheet
from surgicai_vision.evaluation.metrics import EpisodeMetrics
from surgicai_vision.evaluation.slot import Episode, Film
from surgicai_vision.evaluation.storage import (
    FILMS,
    FORMAT,
    MARKER,
    find_evaluations,
    read_film,
    read_rows,
    write_evaluation,
)
from surgicai_vision.report.video import opening_video
from surgicai_vision.training.run_config import RunConfig, Starts

LIMIT = 3_000_000
MACHINE = {
    "packages": {"mujoco": "4.0.0"},
    "python": "3.12.1",
    "system": "Linux",
    "processor": "test",
    "cores": 2,
}


def episode(policy, seed, success):
    """An episode of 90 steps, or of 200 without success."""
    steps = 90 if success else 200
    row = EpisodeMetrics(
        task="grasp",
        policy=policy,
        seed=seed,
        success=success,
        steps=steps,
        trajectory_length_mm=41.5 + seed % 7,
        d_trans_mm=0.8 if success else 6.3,
        d_angle_deg=4.0,
        contact=success,
        error="",
        grasp="friction",
        failure="" if success else "missed",
    )
    kept = np.linspace(0, steps, 9).astype(np.int64)
    return Episode(row, Film(kept, np.stack([kept, np.full(9, seed)], axis=1).astype(np.float64)))


def store(folder, name, successes, views=None, first=names.TEST_SEED):
    """Store an evaluation of 20 episodes, the first from the start `first`."""
    episodes = [episode(name, first + i, i < successes) for i in range(20)]
    about = {"command": "surgicai-vision evaluate", "provenance": {}}
    encoder = name.rsplit("-", 1)[0] if views else None
    policy = name if name in report.REFERENCES else "bc"
    seen = tuple(views or ())
    run = RunConfig(TaskConfig("grasp"), encoder, seen, policy=policy, starts=Starts(first, 20))
    if run.is_trained:
        checkpoint = {
            "weights_sha256": "0123456789abcdef" * 4,
            "dataset": "fedcba9876543210" * 4,
        }
        about |= {"checkpoint": checkpoint, "folder": "policies/x"}
    place = name if first == names.TEST_SEED else f"{name}-{first}"
    return write_evaluation(folder / "evaluations" / place, episodes, run, about)


@pytest.fixture
def results(tmp_path):
    """Results as quickstart leaves them."""
    store(tmp_path, "imagenet-lite-front", 13, ["front"])
    store(tmp_path, "imagenet-lite-back", 9, ["back"])
    store(tmp_path, "random-back", 0, ["back"])
    store(tmp_path, "proprioception", 2)
    store(tmp_path, "expert", 20)
    run = {
        "format": FORMAT,
        "title": "quickstart, grasp",
        "command": "surgicai-vision quickstart",
        "seconds": {"demos": 20.4, "dataset": 61.0},
        "provenance": {**MACHINE, "renderer": "llvmpipe"},
        "data": "25 demonstrations",
    }
    files.write_json(tmp_path / report.RUN_FILE, run)
    return tmp_path


@contextlib.contextmanager
def painted_stage(config, size, quality="high"):
    """Paint images instead of rendering them."""

    def image(state, view, modality="rgb"):
        ramp = np.linspace(40, 220, size).astype(np.uint8)
        frame = np.stack(
            np.broadcast_arrays(ramp[:, None], ramp[None], np.uint8(state[0] % 255)), axis=-1
        )
        frame = np.ascontiguousarray(frame)
        frame[:40, :40] = contact_sheet.PALETTE[names.PARTS.index("needle")]
        return frame

    yield image


@pytest.fixture
def painted(monkeypatch):
    """Paint instead of rendering: these tests are about the page."""
    monkeypatch.setattr(contact_sheet, "state_renderer", painted_stage)


class Page(HTMLParser):
    """Counts tags, collects addresses, and checks that every tag is closed."""

    VOID = ("meta", "link", "img", "br", "input")

    def __init__(self, text):
        super().__init__()
        self.tags, self.addresses, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.addresses += [value for key, value in attributes if key in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)


def assert_stands_alone(text):
    """Check that nothing is loaded from elsewhere, tags are closed, links have targets."""
    page = Page(text)
    assert page.open == []
    inside = {address[1:] for address in page.addresses if address.startswith("#")}
    assert all(address.startswith(("data:", "#")) for address in page.addresses)
    assert all(f'id="{target}"' in text for target in inside)
    assert not re.search(r"https?://|@import|url\(", text)
    return page


def test_page_holds_every_number(results, painted):
    text = report.write_report(results).read_text()
    assert "imagenet-lite on front solves 13 of 20 held-out starts of grasp" in text
    for expected in (
        "13/20",
        "9/20",
        "0/20",
        "2/20",
        "20/20",
        "41–85 %",
        "0–17 %",
        "seeds 900000–900019",
        "20 missed",
        "the same starts, seeds 900000–900019, for every policy",
        "of at most 200 steps",
        "Grasp by friction, paper tolerances.",
    ):
        assert expected in text, expected
    for expected in (
        "25 demonstrations",
        "mujoco 4.0.0",
        "llvmpipe",
        "0123456789abcdef",
        "81 s: demos 20 s",
    ):
        assert expected in text, expected
    assert (
        "surgicai-vision evaluate policies/x --task grasp --episodes 20 --seed 900000 --json"
        in text
    )


def test_page_stands_alone(results, painted):
    path = report.write_report(results)
    page = assert_stands_alone(path.read_text())
    # two views in three modalities, two films of nine frames, five rollouts of eight
    assert page.tags.count("img") == 2 * 3 + 2 * 9 + 5 * 8
    assert path.stat().st_size < LIMIT


def test_without_a_success_or_a_failure_the_page_says_so(tmp_path, painted):
    store(tmp_path, "zero", 0)
    text = report.write_report(tmp_path).read_text()
    assert "No episode of any policy was a success." in text
    assert "zero solves 0 of 20 held-out starts" in text
    store(tmp_path, "zero", 20)
    assert "No episode of any policy was a failure." in report.write_report(tmp_path).read_text()


def test_what_was_counted_on_other_starts_is_no_result(tmp_path, painted):
    store(tmp_path, "imagenet-lite-front", 9, ["front"])
    store(tmp_path, "imagenet-lite-front", 20, ["front"], names.VALIDATION_SEED)
    text = report.write_report(tmp_path).read_text()
    assert "imagenet-lite on front solves 9 of 20 held-out starts of grasp" in text
    assert "imagenet-lite · validation starts" in text and "Success from starts<" in text
    assert "900000–900019 (20 starts), the bank for tests: no training uses it" in text
    assert "500000–500019 (20 starts), the bank for validation: choices are made on it" in text
    assert "for each policy, the starts of seeds 500000–500019 or 900000–900019" in text
    shutil.rmtree(tmp_path / "evaluations/imagenet-lite-front")
    text = report.write_report(tmp_path).read_text()
    assert "solves 20 of 20 validation starts of grasp" in text
    assert "Success from validation starts<" in text and "held-out starts" not in text


def test_films_are_of_a_trained_policy_where_it_has_one(results, painted):
    text = report.write_report(results).read_text()
    assert "imagenet-lite, start 900000, seen by front: success after 90 steps" in text
    assert "imagenet-lite, start 900013, seen by front: failure (missed) after 200 steps" in text


def test_without_gl_the_numbers_remain(results, monkeypatch):
    def no_gl(*_):
        raise SurgicaiError("nothing renders")

    monkeypatch.setattr(contact_sheet, "state_renderer", no_gl)
    text = report.write_report(results).read_text()
    assert "No images: nothing renders" in text
    assert "13/20" in text


def test_a_film_that_cannot_be_shown_takes_no_other_with_it(results, painted):
    damaged = results / "evaluations/imagenet-lite-front" / FILMS  # the best policy's
    damaged.write_bytes(b"no safetensors")
    text = report.write_report(results).read_text()
    assert f"3 films cannot be shown; the first: {damaged} is damaged" in text
    assert "imagenet-lite, start 900000, seen by back: success" in text
    assert "imagenet-lite, start 900009, seen by back: failure" in text
    assert 'alt="front view, RGB"' in text and "No images" not in text
    assert not (results / "tables/failures.jpg").exists(), "films of the best policy are lost"
    for folder in find_evaluations(results):
        (folder / FILMS).write_bytes(b"no safetensors")
    text = report.write_report(results).read_text()
    assert "No images" in text and "13/20" in text and 'src="data:image' not in text
    assert "No episode of any policy" not in text


def test_a_state_that_is_none_of_its_scene_takes_no_other_film_with_it(results, monkeypatch):
    @contextlib.contextmanager
    def stage(config, size, quality="high"):
        def image(state, view, modality="rgb"):
            if state[1] == names.TEST_SEED:
                raise SurgicaiError("a state of another scene")
            return draw(state, view, modality)

        with painted_stage(config, size, quality) as draw:
            yield image

    monkeypatch.setattr(contact_sheet, "state_renderer", stage)
    text = report.write_report(results).read_text()
    assert "films cannot be shown; the first: a state of another scene" in text
    details = json.loads(text.split('id="details">')[1].split("</script>")[0])
    assert any(entry["films"] for entry in details) and (results / "tables/failures.jpg").exists()


def test_names_from_outside_are_escaped(tmp_path, painted):
    evil = "</script><script>alert(1)</script>"
    episodes = [episode(evil, names.TEST_SEED, True)]
    run = RunConfig(TaskConfig("grasp"), evil, ("front",))
    write_evaluation(tmp_path / "evil", episodes, run, {"command": evil, "provenance": {}})
    files.write_json(tmp_path / report.RUN_FILE, {"format": FORMAT, "title": evil})
    text = report.write_report(tmp_path).read_text()
    assert "<script>alert" not in text
    assert text.count("</script>") == 3
    assert Page(text).open == []


def test_results_round_trip(results):
    folder = find_evaluations(results)[0]
    rows = read_rows(folder)
    assert [row["seed"] for row in rows] == list(range(names.TEST_SEED, names.TEST_SEED + 20))
    film = read_film(folder, names.TEST_SEED + 3)
    assert film.states.shape == (9, 2)
    assert film.states[0, 1] == names.TEST_SEED + 3


def test_a_broken_off_evaluation_is_no_result(results, painted):
    for folder in find_evaluations(results):
        (folder / "evaluation.json").unlink()
    with pytest.raises(BadFile, match="holds no evaluation"):
        report.write_report(results)


def test_a_damaged_neighbour_is_a_bad_file(results, tmp_path):
    """Each is refused by name; a crash would raise another type."""
    marker = next(results.rglob("evaluation.json"))
    run = {"format": FORMAT}
    about = {**files.read_json(marker)["about"]}
    damaged = {
        "probes.parquet": [b"no parquet"],
        "probe.json": [b'{"rows": 3}', b"3", b"null", b"[3]", b'[{"view": [1]}]'],
        "x/failed.json": [{**run}, {**run, "run": 3}],
        "run.json": [
            {**run, **wrong}
            for wrong in (
                {"skipped": 3},
                {"skipped": [3]},
                {"skipped": [{}]},
                {"problems": 3},
                {"seconds": {"demos": "x"}},
                {"headline": "x"},
                {"provenance": "x"},
            )
        ],
        str(marker.relative_to(results)): [
            {**files.read_json(marker), "about": {**about, **wrong}}
            for wrong in ({"checkpoint": "x"}, {"provenance": "x"}, {"high_level": {"a": 1}})
        ],
    }
    for name, contents in damaged.items():
        path = results / name
        path.parent.mkdir(exist_ok=True)
        whole = path.read_bytes() if path.exists() else None
        for content in contents:
            path.write_bytes(
                content if isinstance(content, bytes) else json.dumps(content).encode()
            )
            with pytest.raises(BadFile, match=path.name):
                report.write_report(results)
        path.unlink() if whole is None else path.write_bytes(whole)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.replace(b"missed", b"miss\xffd"),
        lambda content: content.replace(b"missed", b"nissed"),
        lambda content: content.replace(b"success", b"\xffuccess"),
        lambda content: content.replace(b"success", b"puccess"),
    ],
)
def test_a_flipped_byte_in_the_episodes_is_a_bad_file(results, change):
    path = next(results.rglob("episodes.parquet"))
    pq.write_table(pq.read_table(path), path, compression="none", use_dictionary=False)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(BadFile, match=r"episodes\.parquet is damaged"):
        read_rows(path.parent)


def test_depth_and_parts_are_coloured():
    depth = np.linspace(0.05, 0.2, 64 * 64, dtype=np.float32).reshape(64, 64, 1)
    near, far = contact_sheet.coloured(depth, "depth")[[0, -1], [0, -1]].astype(int)
    assert near[0] > near[2], "near is red"
    assert far[2] > far[0], "far is blue"
    parts = np.full((4, 4, 1), names.PARTS.index("needle"), np.uint8)
    assert (contact_sheet.coloured(parts, "segmentation") == contact_sheet.PALETTE[2]).all()


@pytest.mark.parametrize("poster", ["../outside.jpg", "film.webm"])
def test_a_page_opens_with_files_of_its_folder_alone(tmp_path, poster):
    folder = tmp_path / "results"
    folder.mkdir()
    for path in (folder / "film.mp4", folder / "film.webm", tmp_path / "outside.jpg"):
        path.write_bytes(b"content")
    told = {"file": "film.mp4", "poster": "none.jpg", "strip": "", "title": "t", "text": "t"}
    page = folder / report.PAGE_FILE
    assert opening_video(folder, page, {"video": told})["poster"] == ""
    assert opening_video(folder, page, {"video": {**told, "poster": poster}}) is None


def test_an_evaluation_that_names_no_packages_has_a_page(tmp_path, painted):
    store(tmp_path, "zero", 3)
    path = tmp_path / "evaluations" / "zero" / MARKER
    stored = json.loads(path.read_text())
    stored["about"]["provenance"] = {"packages": None}
    files.write_json(path, stored)
    assert "3/20" in report.write_report(tmp_path, strips=0).read_text()
