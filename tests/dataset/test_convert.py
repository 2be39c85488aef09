"""Converting a dataset without rendering: fewer views, videos."""

import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_demos import render_with_fake_env, write_demos

from surgicai_vision.commands.options import VIDEO
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, UnknownName
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import (
    check_dataset,
    convert_dataset,
    open_dataset,
    render_demos,
    video_jobs,
)
from surgicai_vision.dataset.video import CODECS, VideoWriter

CONFIG = TaskConfig(max_steps=12)
SIZE = 64


@pytest.fixture(autouse=True)
def offline(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def demos(tmp_path, monkeypatch):
    render_with_fake_env(monkeypatch, CONFIG)
    folder = write_demos(tmp_path / "demos", CONFIG, (1, 2, 4))
    return folder


def render(demos, out, **more):
    return render_demos(
        demos, out, **{"size": SIZE, "depth": True, "context": RunContext(0), **more}
    )


def test_a_subset_of_views_is_what_rendering_them_gives(tmp_path, demos):
    render(demos, tmp_path / "both")
    made = convert_dataset(tmp_path / "both", tmp_path / "front", views=("front",))
    rendered = render(demos, tmp_path / "alone", views=("front",))
    assert made.digest == rendered.digest
    assert made.video_error == {}
    files = sorted(
        path.relative_to(tmp_path / "alone") for path in (tmp_path / "alone").rglob("*.*")
    )
    for name in files:
        if str(name) != names.META_FILE:
            assert (tmp_path / "front" / name).read_bytes() == (
                tmp_path / "alone" / name
            ).read_bytes(), name
    assert check_dataset(tmp_path / "front").problems == ()
    assert list(open_dataset(tmp_path / "front").meta["cameras"]) == ["front"]


def test_views_come_in_the_order_asked_for(tmp_path, demos):
    render(demos, tmp_path / "set")
    convert_dataset(tmp_path / "set", tmp_path / "turned", views=("back", "front"))
    assert open_dataset(tmp_path / "turned").views == ("back", "front")
    assert check_dataset(tmp_path / "turned").problems == ()


@pytest.mark.parametrize("codec", CODECS)
def test_video_is_read_by_us_and_by_lerobot_and_its_error_is_measured(tmp_path, demos, codec):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    render(demos, tmp_path / "set")
    made = render(demos, tmp_path / "video", video=codec)
    before = open_dataset(tmp_path / "set")
    after = open_dataset(tmp_path / "video")
    assert check_dataset(tmp_path / "video").problems == ()
    theirs = LeRobotDataset(
        "local/set", root=tmp_path / "video", video_backend="pyav", depth_output_unit="m"
    )
    for view in ("front", "back"):
        frames = after.frames(view)
        error = np.abs(frames.astype(float) - before.frames(view)).mean()
        assert made.video_error[view] == pytest.approx(error, abs=1e-4)
        assert 0 < error < 12
        np.testing.assert_array_equal(after.frames(view, 7, 9), frames[7:9])
        for index in (0, 8, after.length - 1):
            image = np.round(theirs[index][names.image_key(view)].numpy().transpose(1, 2, 0) * 255)
            assert np.abs(image - frames[index]).max() <= 2, "two converters from YUV"
    np.testing.assert_array_equal(after.depth("back"), before.depth("back"))
    assert after.meta["video"] == codec
    assert after.meta["video_error"] == made.video_error
    with pytest.raises(OutputExists):
        render(demos, tmp_path / "video")


def test_a_dataset_that_was_replaced_is_encoded_anew(tmp_path, demos):
    """Regression: in one process, the videos showed the dataset that had been there before."""
    render(demos, tmp_path / "set", video="h264")
    shutil.rmtree(tmp_path / "set")
    others = write_demos(tmp_path / "others", CONFIG, (5, 6, 7))
    render(others, tmp_path / "set", video="h264")
    assert check_dataset(tmp_path / "set").problems == ()
    render(others, tmp_path / "images")
    shown = open_dataset(tmp_path / "set").frames("front").astype(int)
    assert np.abs(shown - open_dataset(tmp_path / "images").frames("front")).mean() < 4


def test_videos_are_encoded_in_blocks_and_do_not_depend_on_the_workers(
    tmp_path, demos, monkeypatch
):
    render(demos, tmp_path / "set")
    monkeypatch.setattr(video_jobs, "BLOCK_FRAMES", 8)
    alone = convert_dataset(
        tmp_path / "set", tmp_path / "alone", video="h264", context=RunContext(0)
    )
    monkeypatch.setattr(video_jobs, "_dataset", None)  # this process encodes nothing
    together = convert_dataset(
        tmp_path / "set", tmp_path / "together", video="h264", context=RunContext(2)
    )
    assert (alone.digest, alone.video_error) == (together.digest, together.video_error)
    assert (
        open_dataset(tmp_path / "alone").fingerprint
        == open_dataset(tmp_path / "together").fingerprint
    )
    assert len(list((tmp_path / "alone").rglob("*.mp4"))) == 4, (
        "two views, three episodes in two blocks"
    )
    assert check_dataset(tmp_path / "together").problems == ()


@pytest.mark.parametrize("codec", CODECS)
def test_an_encoder_leaves_this_thread_its_scheduling(tmp_path, codec):
    """As root, SVT-AV1 would give it real-time scheduling at the highest priority."""

    def schedule() -> tuple[int, int]:
        return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority

    before = schedule()
    with VideoWriter(tmp_path / "a.mp4", codec, 25, SIZE) as writer:
        writer.add(np.zeros((SIZE, SIZE, 3), np.uint8))
        assert schedule() == before
    assert schedule() == before


def test_views_of_a_video_dataset(tmp_path, demos):
    render(demos, tmp_path / "video", video="h264")
    convert_dataset(tmp_path / "video", tmp_path / "back", views=("back",))
    assert check_dataset(tmp_path / "back").problems == ()
    np.testing.assert_array_equal(
        open_dataset(tmp_path / "back").frames("back"),
        open_dataset(tmp_path / "video").frames("back"),
    )
    with pytest.raises(InputError, match="already holds videos"):
        convert_dataset(tmp_path / "video", tmp_path / "again", video="av1")


def test_a_place_far_beyond_a_video_is_a_bad_file(tmp_path, demos):
    render(demos, tmp_path / "video", video="h264")
    file = tmp_path / "video/meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    key = f"videos/{names.image_key('front')}/from_timestamp"
    places = pa.array([1e30] * len(table))
    pq.write_table(table.set_column(table.column_names.index(key), key, places), file)
    with pytest.raises(BadFile, match="cannot be decoded"):
        open_dataset(tmp_path / "video").frames("front")
    assert not check_dataset(tmp_path / "video").ok


@pytest.mark.parametrize(
    "spoil",
    [
        lambda table: table.slice(0, 2),
        lambda table: pa.concat_tables([table, table]),
        lambda table: moved(table, "dataset_from_index", -1),
        lambda table: moved(table, "dataset_from_index", 1),
    ],
    ids=["lost", "doubled", "overlap", "gap"],
)
def test_videos_of_other_episodes_than_the_data_has_are_refused(tmp_path, demos, spoil):
    render(demos, tmp_path / "video", video="h264")
    file = tmp_path / "video/meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(spoil(pq.read_table(file)), file)
    with pytest.raises(BadFile, match="are not those of the episodes in the data"):
        open_dataset(tmp_path / "video").frames("front")
    assert not check_dataset(tmp_path / "video").ok


@pytest.mark.parametrize(
    ("video", "column", "values"),
    [
        ("h264", f"videos/{names.image_key('front')}/chunk_index", None),
        ("h264", f"videos/{names.image_key('front')}/chunk_index", ["a"] * 3),
        (None, f"stats/{names.STATE}/std", [0.5] * 3),
        (None, f"stats/{names.STATE}/mean", None),
    ],
)
def test_damaged_rows_of_episodes_are_refused(tmp_path, demos, video, column, values):
    render(demos, tmp_path / "set", video=video)
    file = tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    place = table.column_names.index(column)
    spoilt = (
        table.remove_column(place)
        if values is None
        else table.set_column(place, column, pa.array(values))
    )
    pq.write_table(spoilt, file)
    with pytest.raises(BadFile, match=r"is damaged .*; repair it first"):
        convert_dataset(tmp_path / "set", tmp_path / "front", views=("front",))
    assert not (tmp_path / "front").exists()


def moved(table, column, by):
    """Return a table of episodes with a number of its second one changed."""
    values = table.column(column).to_pylist()
    values[1] += by
    return table.set_column(table.column_names.index(column), column, pa.array(values))


def test_the_same_command_again_does_nothing_and_wrong_ones_are_refused(tmp_path, demos):
    render(demos, tmp_path / "set")
    first = convert_dataset(tmp_path / "set", tmp_path / "back", views=("back",))
    shutil.rmtree(tmp_path / "set/data/chunk-000", ignore_errors=False)
    (tmp_path / "set").rename(tmp_path / "gone")
    render(demos, tmp_path / "set")
    assert (
        convert_dataset(tmp_path / "set", tmp_path / "back", views=("back",)).digest == first.digest
    )
    with pytest.raises(OutputExists):
        convert_dataset(tmp_path / "set", tmp_path / "back", views=("front",))
    with pytest.raises(UnknownName, match="Allowed: back, front"):
        convert_dataset(tmp_path / "set", tmp_path / "other", views=("wrist_psm1",))
    with pytest.raises(UnknownName, match="Did you mean 'h264'"):
        convert_dataset(tmp_path / "set", tmp_path / "other", video="h26")
    with pytest.raises(InputError, match="each once"):
        convert_dataset(tmp_path / "set", tmp_path / "other", views=("back", "back"))
    assert not (tmp_path / "other").exists()
    assert not list(tmp_path.glob("*.work"))


def test_a_damaged_page_is_refused_and_leaves_nothing(tmp_path, demos):
    render(demos, tmp_path / "set")
    data = tmp_path / "set/data/chunk-000/file-000.parquet"
    episode = pq.ParquetFile(data).metadata.row_group(1)
    columns = (episode.column(number) for number in range(episode.num_columns))
    start = next(
        column.data_page_offset
        for column in columns
        if column.path_in_schema == f"{names.image_key('front')}.bytes"
    )
    content = bytearray(data.read_bytes())
    content[start : start + 16] = b"\xff" * 16
    data.write_bytes(content)
    with pytest.raises(BadFile, match=r"1 of 3 episodes and .* cannot be read further"):
        convert_dataset(tmp_path / "set", tmp_path / "back", views=("back",))
    assert not (tmp_path / "back").exists()


def test_the_command_line_knows_the_codecs(tmp_path, demos, capsys):
    from surgicai_vision.commands.main import main

    assert tuple(CODECS) == VIDEO.choices
    render(demos, tmp_path / "set")
    assert main(["dataset", "convert", str(tmp_path / "set"), "--view", "back", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["dataset"] == str(tmp_path / "set-back")
    assert main(["dataset", "convert", str(tmp_path / "set")]) == 2
