"""Datasets: rendered from states, LeRobot's format, nothing lost."""

import dataclasses
import json
import math
import os
import re
import struct
import subprocess
import sys
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_dataset import recorded as recorded_frames
from fake_demos import write_demos
from fake_env import FakeEnv
from shown import showing

from surgicai_vision import envs
from surgicai_vision.commands import record_demos
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, UnknownName
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import (
    check_dataset,
    codecs,
    metadata,
    open_dataset,
    reader,
    render_demos,
    render_jobs,
    schema,
)
from surgicai_vision.dataset.stats import ImageStatistics, column_statistics
from surgicai_vision.dataset.subset import with_frame_stride
from surgicai_vision.demos.record import record
from surgicai_vision.demos.store import list_demos, read_demo, read_marker
from surgicai_vision.evaluation.policy_spec import open_policy

CONFIG = TaskConfig(max_steps=12)
SIZE = 32


@pytest.fixture
def fake(monkeypatch):
    """Render with the stand-in environment, in this process."""

    def env(config, *rest):
        return FakeEnv(CONFIG, *rest)

    monkeypatch.setattr(render_jobs, "_env", env)
    monkeypatch.setattr(render_jobs, "_renderer", lambda: "none")


@pytest.fixture
def demos(tmp_path):
    folder = write_demos(tmp_path / "demos", CONFIG, (1, 2, 4))
    return folder


def render(demos, out, **more):
    options = {"size": SIZE, "depth": True, "context": RunContext(0), **more}
    return render_demos(demos, out, **options)


def test_every_frame_is_the_image_of_its_state(tmp_path, fake, demos):
    summary = render(demos, tmp_path / "set", segmentation=True)
    dataset = open_dataset(tmp_path / "set")
    episodes = [read_demo(path) for path in list_demos(demos)]
    env = FakeEnv(CONFIG, image_size=SIZE, depth=True, segmentation=True)
    frame = 0
    columns = dataset.columns()
    for number, episode in enumerate(episodes):
        for step, state in enumerate(episode.state[:-1]):
            env.set_state_vector(state)
            observation = env.observe()
            for view in ("front", "back"):
                np.testing.assert_array_equal(
                    dataset.frames(view, frame, frame + 1)[0], observation[view]
                )
                np.testing.assert_array_equal(
                    dataset.depth(view, frame, frame + 1)[0], observation[f"{view}_depth"]
                )
                parts = dataset.segmentation(view, frame, frame + 1)[0]
                np.testing.assert_array_equal(parts, observation[f"{view}_segmentation"])
            np.testing.assert_array_equal(columns[names.STATE][frame], env.agent_pos())
            np.testing.assert_array_equal(columns[names.BOTH_ARMS][frame], env.both_arms())
            np.testing.assert_array_equal(columns[names.SETPOINT][frame], env.setpoint())
            np.testing.assert_array_equal(
                columns[names.PRIVILEGED_STATE][frame], env.state_vector()
            )
            np.testing.assert_array_equal(columns[names.ACTION][frame], episode.action[step])
            assert columns[names.SEED][frame] == episode.seed
            assert columns[names.DONE][frame] == (step == len(episode) - 1)
            assert dataset.episode_index[frame] == number
            assert columns["index"][frame] == frame
            frame += 1
    assert frame == dataset.length == summary.frames
    assert summary.episodes == 3


def test_every_fifth_frame_is_one_of_all(tmp_path, fake, demos, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    render(demos, tmp_path / "all")
    summary = render(demos, tmp_path / "set", frame_stride=5)
    whole, few = open_dataset(tmp_path / "all"), open_dataset(tmp_path / "set")
    rows = np.concatenate([np.arange(start, stop, 5) for start, stop in whole.bounds()])
    assert summary.frames == few.length == len(rows) < whole.length
    assert (few.fps, whole.fps) == (10, 50)
    np.testing.assert_array_equal(few.frames("back"), whole.frames("back")[rows])
    np.testing.assert_array_equal(few.depth("front"), whole.depth("front")[rows])
    for key in schema.columns(whole.views):
        if key != names.DONE:
            np.testing.assert_array_equal(few.columns()[key], whole.columns()[key][rows])
    np.testing.assert_allclose(
        few.columns()["timestamp"], whole.columns()["timestamp"][rows], atol=1e-6
    )
    assert check_dataset(tmp_path / "set").problems == ()
    lerobot = LeRobotDataset("local/set", root=tmp_path / "set")
    assert lerobot.fps == 10 and len(lerobot) == few.length
    assert with_frame_stride(few, 5) is few
    np.testing.assert_array_equal(
        with_frame_stride(few, 10).columns()[names.SEED],
        with_frame_stride(whole, 10).columns()[names.SEED],
    )
    with pytest.raises(InputError, match="the dataset holds one every 5"):
        with_frame_stride(few, 1)
    with pytest.raises(InputError, match=r"frame_stride is 4; .* 1, 2, 5, 10, 25, 50"):
        render(demos, tmp_path / "none", frame_stride=4)
    with pytest.raises(InputError, match="a replay needs one for each step"):
        open_policy("replay", dataset=few)


@pytest.mark.parametrize("stride", [3, 9, 60])
def test_a_stride_that_the_frames_have_already_changes_nothing(stride):
    dataset = with_frame_stride(recorded_frames(2, 130), stride)
    assert with_frame_stride(dataset, stride) is dataset
    assert with_frame_stride(dataset, 2 * stride).length == 2 * math.ceil(130 / (2 * stride))


def test_frames_of_held_actions_are_that_many_control_steps_apart(tmp_path, fake):
    held = dataclasses.replace(CONFIG, action_repeat=2)
    demos = write_demos(tmp_path / "demos", held, (1, 2))
    for stride, fps in ((1, 25), (5, 5)):
        render(demos, tmp_path / f"every{stride}", frame_stride=stride)
        dataset = open_dataset(tmp_path / f"every{stride}")
        assert dataset.fps == fps and dataset.config.action_repeat == 2
        columns = dataset.columns()
        seconds = columns["frame_index"] * 2 * stride / names.FPS
        np.testing.assert_allclose(columns["timestamp"], seconds, atol=1e-6)
        assert check_dataset(dataset.path).problems == ()
        assert with_frame_stride(dataset, 2 * stride) is dataset
    assert open_policy("replay", dataset=open_dataset(tmp_path / "every1")).name == "replay"
    with pytest.raises(InputError, match="a replay needs one for each step: 25"):
        open_policy("replay", dataset=open_dataset(tmp_path / "every5"))
    uneven = write_demos(tmp_path / "uneven", dataclasses.replace(CONFIG, action_repeat=4), (1, 2))
    with pytest.raises(InputError, match="a frame every 4 control steps"):
        render(uneven, tmp_path / "none")


def test_frames_across_episodes_equal_single_frames(tmp_path, fake, demos):
    render(demos, tmp_path / "set")
    dataset = open_dataset(tmp_path / "set")
    whole = dataset.frames("back")
    assert whole.shape == (dataset.length, SIZE, SIZE, 3)
    np.testing.assert_array_equal(whole[3:-2], dataset.frames("back", 3, dataset.length - 2))
    assert dataset.frames("back", 4, 4).shape == (0, SIZE, SIZE, 3)
    with pytest.raises(InputError, match="the dataset has 0 to"):
        dataset.frames("back", 0, dataset.length + 1)
    with pytest.raises(UnknownName, match="view of this dataset"):
        dataset.frames("wrist_psm1", 0, 1)


class OneThread:
    """A parquet file that no second thread may read meanwhile, as pyarrow's must not be."""

    def __init__(self, file):
        self.file = file
        self.free = threading.Lock()

    def read_row_group(self, *arguments):
        assert self.free.acquire(blocking=False)
        try:
            os.sched_yield()
            return self.file.read_row_group(*arguments)
        finally:
            self.free.release()


def test_several_threads_read_one_dataset(tmp_path, fake, demos):
    render(demos, tmp_path / "set")
    whole = open_dataset(tmp_path / "set")
    frames = {view: whole.frames(view) for view in whole.policy_views}
    dataset = open_dataset(tmp_path / "set")
    dataset._files = [OneThread(file) for file in dataset._files]
    wanted = [(view, at) for at, _ in whole.bounds() for view in frames] * 20

    def same(view, at):
        return np.array_equal(dataset.frames(view, at, at + 1)[0], frames[view][at])

    with ThreadPoolExecutor(4) as readers:
        assert all(readers.map(same, *zip(*wanted, strict=True)))


def test_few_decoded_images_wait_for_their_reader(tmp_path, fake, demos, monkeypatch):
    render(demos, tmp_path / "set")
    dataset = open_dataset(tmp_path / "set")
    decoded = []

    class AtOnce:
        """Threads that have decoded everything they were given when a reader asks."""

        def __init__(self, threads):
            assert threads == reader.DECODERS

        def __enter__(self):
            return self

        def __exit__(self, *error):
            decoded.append("closed")

        def map(self, decode, contents, places):
            decoded.extend(places)
            return map(decode, contents, places)

    monkeypatch.setattr(reader, "ThreadPoolExecutor", AtOnce)
    monkeypatch.setattr(reader, "MOST_DECODED", 2)
    first, last = max(dataset.bounds(), key=lambda bounds: bounds[1] - bounds[0])
    assert last - first > 4
    images = dataset.decoded(names.image_key("front"), first, last)
    for seen in range(1, last - first + 1):
        next(images)
        assert seen <= len(decoded) <= seen + 1
    images.close()
    assert decoded[-1] == "closed"


def test_an_image_column_of_numbers_is_refused(tmp_path, fake, demos):
    render(demos, tmp_path / "set")
    data = tmp_path / "set/data/chunk-000/file-000.parquet"
    numbers = pa.array([{"bytes": 5, "path": "x"}] * len(pq.read_table(data)))
    place = pq.read_schema(data).get_field_index(FRONT)
    rewrite(data, lambda table: table.set_column(place, FRONT, numbers))
    with pytest.raises(BadFile, match=f"{FRONT} holds int64, not images"):
        open_dataset(tmp_path / "set").frames("front")


def test_digest_is_that_of_the_decoded_content(tmp_path, fake, demos):
    summary = render(demos, tmp_path / "set", segmentation=True)
    dataset = open_dataset(tmp_path / "set")
    keys = [key for key, _, _ in schema.image_keys(dataset.views, True, True)]
    columns, digests = dataset.columns(), []
    decoded = {key: list(dataset.decoded(key, 0, dataset.length)) for key in keys}
    for number in range(3):
        rows = np.flatnonzero(dataset.episode_index == number)
        digest = schema.EpisodeDigest(keys)
        for key in keys:
            for row in rows:
                digest.add(key, decoded[key][row])
        episode = {key: columns[key][rows] for key in schema.columns(dataset.views)}
        digests.append(digest.hexdigest(episode, dataset.views))
    assert schema.dataset_digest(digests) == summary.digest == dataset.meta["digest"]


def test_interrupted_rendering_continues_to_the_same_bytes(tmp_path, fake, demos):
    def stop(done, total, unit):
        if done:
            raise KeyboardInterrupt

    whole = render(demos, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        render(demos, tmp_path / "set", context=RunContext(0, stage=showing(stop)))
    assert not (tmp_path / "set").exists()
    assert render(demos, tmp_path / "set").digest == whole.digest
    assert (
        open_dataset(tmp_path / "set").fingerprint == open_dataset(tmp_path / "whole").fingerprint
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demos", "set", "whole"]


def test_rendering_again_does_nothing_and_other_options_are_refused(
    tmp_path, fake, demos, monkeypatch
):
    first = render(demos, tmp_path / "set")
    monkeypatch.setattr(render_jobs, "_env", None)
    assert render(demos, tmp_path / "set").digest == first.digest
    with pytest.raises(OutputExists, match="other demonstrations or options"):
        render(demos, tmp_path / "set", size=64)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/note.txt").write_text("mine")
    with pytest.raises(OutputExists, match="already holds files"):
        render(demos, tmp_path / "full")


def test_bad_requests_are_refused_before_any_work(tmp_path, demos):
    with pytest.raises(UnknownName, match="Did you mean 'front'"):
        render(demos, tmp_path / "set", views=("frnt",))
    with pytest.raises(InputError, match="at least one, each once"):
        render(demos, tmp_path / "set", views=("front", "front"))
    with pytest.raises(InputError, match="size is 4"):
        render(demos, tmp_path / "set", size=4)
    with pytest.raises(InputError, match="size is 63, and an h264 video needs an even size"):
        render(demos, tmp_path / "set", size=63, video="h264")
    with pytest.raises(InputError, match="size is 16, and an av1 video needs at least 32"):
        render(demos, tmp_path / "set", size=16, video="av1")
    with pytest.raises(BadFile, match="not a folder of demonstrations"):
        render(tmp_path / "nothing", tmp_path / "set")
    assert not (tmp_path / "set.work").exists()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["--frame-stride", "3"], "frame_stride is 3"),
        (["--size", "63", "--video", "h264"], "size is 63"),
        (["--layout", "open-h", "--video", "h264"], "convert_image_to_video"),
        (["--layout", "open-h", "--frame-stride", "5", "--config", "held.yaml"], "for 20 control"),
        (["--config", "held.yaml"], "a frame every 4 control steps"),
    ],
)
def test_the_command_refuses_them_before_it_records(tmp_path, monkeypatch, capsys, wrong, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "held.yaml").write_text("env: {action_repeat: 4}")
    monkeypatch.setattr(record_demos, "run", None)
    assert main(["render-demos", *wrong]) == 2
    assert said in capsys.readouterr().err


def test_demos_of_another_scene_are_refused(tmp_path, fake, demos, monkeypatch):
    class Other(FakeEnv):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self.scene.hash = "0" * 64

    monkeypatch.setattr(render_jobs, "_env", lambda config, *rest: Other(CONFIG, *rest))
    with pytest.raises(InputError, match="recorded in another scene"):
        render(demos, tmp_path / "set")


def test_lerobot_opens_it_offline(tmp_path, fake, demos, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    render(demos, tmp_path / "set")
    ours = open_dataset(tmp_path / "set")
    theirs = LeRobotDataset(
        "local/set", root=tmp_path / "set", depth_output_unit="m", video_backend="pyav"
    )
    assert (theirs.num_frames, theirs.num_episodes, theirs.fps) == (ours.length, 3, names.FPS)
    for index in (0, 5, ours.length - 1):
        item = theirs[index]
        assert item["task"] == names.TASK_TEXTS["grasp"]
        rgb = np.round(item[names.image_key("back")].numpy().transpose(1, 2, 0) * 255).astype(
            np.uint8
        )
        np.testing.assert_array_equal(rgb, ours.frames("back", index, index + 1)[0])
        depth = item[names.depth_key("front")].numpy()[0]
        np.testing.assert_array_equal(depth, ours.depth("front", index, index + 1)[0, ..., 0])
        np.testing.assert_array_equal(
            item[names.ACTION].numpy(), ours.columns()[names.ACTION][index]
        )
    _edit(theirs, tmp_path)
    statistics = theirs.meta.stats[names.ACTION]
    np.testing.assert_allclose(statistics["mean"], ours.columns()[names.ACTION].mean(0), atol=1e-6)
    np.testing.assert_allclose(statistics["std"], ours.columns()[names.ACTION].std(0), atol=1e-6)


def test_statistics_equal_lerobots(fake):
    from lerobot.datasets.compute_stats import get_feature_stats

    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (6, 20, 24, 3), dtype=np.uint8)
    running = ImageStatistics()
    for frame in frames:
        running.add(frame)
    theirs = get_feature_stats(frames.transpose(0, 3, 1, 2), axis=(0, 2, 3), keepdims=True)
    ours = running.result()
    for name in ("min", "max", "mean", "std"):
        assert np.shape(ours[name]) == (3, 1, 1)
        # LeRobot's std differs from numpy's by 4e-5 here; ours is exact.
        np.testing.assert_allclose(ours[name], theirs[name][0] / 255, atol=1e-4)
        exact = getattr(frames / 255.0, name)(axis=(0, 1, 2))
        np.testing.assert_allclose(np.ravel(ours[name]), exact, atol=1e-12)
    values = rng.normal(size=(50, 7))
    theirs = get_feature_stats(values, axis=0, keepdims=False)
    ours = column_statistics(values)
    assert set(ours) == set(theirs)
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-9)
    np.testing.assert_allclose(ours["q50"], theirs["q50"], atol=0.1)


def _edit(dataset, folder):
    """Split, delete and merge with LeRobot's own tools; frames and depth must survive."""
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset

    parts = split_dataset(dataset, {"a": [0], "b": [1, 2]}, output_dir=folder / "split")
    merged = merge_datasets([parts["a"], parts["b"]], "local/merged", folder / "merged")
    shorter = delete_episodes(merged, [1], folder / "shorter", "local/shorter")
    assert (merged.num_frames, shorter.num_episodes) == (dataset.num_frames, 2)
    for key in (names.image_key("front"), names.depth_key("back"), names.ACTION, names.SEED):
        assert merged[-1][key].equal(dataset[-1][key]) or "depth" in key
        assert shorter[0][key].equal(merged[0][key])


def test_metadata_equals_lerobots(tmp_path, fake, demos):
    """What we write without LeRobot is what LeRobot writes: tables, types and numbers."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    render(demos, tmp_path / "set", segmentation=True)
    table = schema.features(("front", "back"), SIZE, True, True)
    theirs = LeRobotDatasetMetadata.create(
        "local/set",
        names.FPS,
        table,
        robot_type=metadata.ROBOT_TYPE,
        root=tmp_path / "theirs",
        use_videos=False,
    )
    text = names.TASK_TEXTS["grasp"]
    theirs.save_episode_tasks([text])
    ours = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet")
    for row in ours.to_pylist():
        place = {key: row[key] for key in row if key.startswith(("data/", "dataset_"))}
        statistics = {}
        for key in row:
            if key.startswith("stats/"):
                _, feature, name = key.split("/")
                statistics.setdefault(feature, {})[name] = np.array(row[key])
        theirs.save_episode(row["episode_index"], row["length"], row["tasks"], statistics, place)
    theirs.finalize()
    written = pq.read_table(tmp_path / "theirs/meta/episodes/chunk-000/file-000.parquet")
    assert ours.select(written.column_names).equals(written)
    for name in ("info.json", "stats.json"):
        one, two = (
            json.loads((tmp_path / which / "meta" / name).read_text())
            for which in ("set", "theirs")
        )
        if name == "info.json":
            assert one == two
            assert list(one["features"]) == list(two["features"])
        else:
            assert one.keys() == two.keys()
            for key in one:
                for statistic in one[key]:
                    np.testing.assert_allclose(one[key][statistic], two[key][statistic], atol=1e-9)
    one, two = (
        pq.read_table(tmp_path / which / "meta/tasks.parquet") for which in ("set", "theirs")
    )
    assert one.equals(two)
    arrow = get_hf_features_from_features(theirs.features).arrow_schema
    data = pq.read_schema(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert data.equals(arrow)
    assert json.loads(data.metadata[b"huggingface"]) == json.loads(arrow.metadata[b"huggingface"])


@pytest.mark.parametrize("shape", [(20, 30, 3), (17, 17, 1)])
def test_images_are_lossless(shape):
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, shape, dtype=np.uint8)
    np.testing.assert_array_equal(codecs.decode(codecs.encode(rgb), "x")[..., : shape[2]], rgb)
    depth = rng.random((20, 30, 1), dtype=np.float32)
    np.testing.assert_array_equal(codecs.decode(codecs.encode(depth), "x"), depth)


def test_a_dataset_knows_how_late_its_demonstrators_noticed_a_loss(tmp_path, fake, demos):
    render(demos, tmp_path / "set")
    assert open_dataset(tmp_path / "set").made.late == 0
    meta = tmp_path / "set" / names.META_FILE
    content = json.loads(meta.read_text())
    assert content["demos_requests"] == [read_marker(demos).get("request")]
    for requests, late in (([{"late": 40}, None, {"late": 5}], 40), ([], 0)):
        meta.write_text(json.dumps({**content, "demos_requests": requests}))
        assert open_dataset(tmp_path / "set").made.late == late
    meta.write_text(json.dumps({**content, "demos_requests": ["late"]}))
    with pytest.raises(BadFile, match="is damaged"):
        open_dataset(tmp_path / "set")


@pytest.mark.parametrize(
    "spoil",
    [
        *("no meta", "not json", "key gone", "short data", "data gone", "not parquet"),
        *({"image_size": 10**9}, {"image_size": 1e999}, {"fps": 0}, {"variants": 0}),
        *(
            {"frames": 0},
            {"cameras": {}},
            {"cameras": {"front": 1}},
            {"digest": None},
            {"episodes": "1"},
        ),
    ],
    ids=str,
)
def test_damaged_dataset_is_a_bad_file(tmp_path, fake, demos, spoil):
    render(demos, tmp_path / "set", depth=False)
    meta, data = (
        tmp_path / "set" / names.META_FILE,
        tmp_path / "set/data/chunk-000/file-000.parquet",
    )
    content = json.loads(meta.read_text())
    if spoil == "no meta":
        meta.unlink()
    elif spoil == "not json":
        meta.write_text("{")
    elif isinstance(spoil, dict):
        meta.write_text(json.dumps({**content, **spoil}))
        if "frames" in spoil:
            data.unlink()
    elif spoil == "key gone":
        del content["views"]
        meta.write_text(json.dumps(content))
    elif spoil == "short data":
        data.write_bytes(data.read_bytes()[:-20])
    elif spoil == "data gone":
        data.unlink()
    else:
        data.write_bytes(b"PAR1 is not enough PAR1")
    with pytest.raises(BadFile) as caught:
        open_dataset(tmp_path / "set")
    assert "\n" not in str(caught.value)


def test_a_dataset_of_another_format_is_refused_in_one_line(tmp_path, fake, demos):
    render(demos, tmp_path / "set", depth=False)
    meta = tmp_path / "set" / names.META_FILE
    content = json.loads(meta.read_text())
    del content["format"]  # as surgicai-vision 0.1 wrote it
    meta.write_text(json.dumps(content))
    with pytest.raises(BadFile, match=r"another version .*format 1; this version reads 3.*render"):
        open_dataset(tmp_path / "set")


def test_demonstrations_given_twice_are_refused(tmp_path, fake, demos, capsys):
    (tmp_path / "link").symlink_to(demos)
    for twice in ([demos, demos], [demos, tmp_path / "link"], [demos, demos / ".." / demos.name]):
        with pytest.raises(InputError, match="are given twice; give each folder once"):
            render(twice, tmp_path / "set")
    assert not (tmp_path / "set").exists()
    arguments = ["--demos", f"{demos},{demos}", "--out", str(tmp_path / "set")]
    assert main(["render-demos", *arguments]) == 2
    assert "are given twice" in capsys.readouterr().err


def test_one_row_group_an_episode(tmp_path, fake, demos):
    render(demos, tmp_path / "set")
    file = pq.ParquetFile(tmp_path / "set/data/chunk-000/file-000.parquet")
    lengths = [len(read_demo(path)) for path in list_demos(demos)]
    assert [
        file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)
    ] == lengths


def rewrite(path, change):
    """Write a data file again with one column changed by `change(table)`."""
    table = pq.read_table(path)
    pq.write_table(change(table), path, row_group_size=len(table))


def image(frame):
    return {"bytes": codecs.encode(frame), "path": "x"}


def with_image(table, key, row, value):
    column = table.column(key).to_pylist()
    column[row] = value if isinstance(value, dict) else column[value]
    field = table.field(key)
    return table.set_column(table.schema.get_field_index(key), field, pa.array(column, field.type))


def with_value(table, key, row, value):
    column = table.column(key).to_pylist()
    column[row] = value
    field = table.field(key)
    return table.set_column(table.schema.get_field_index(key), field, pa.array(column, field.type))


FRONT, DEPTH = names.image_key("front"), names.depth_key("back")
DAMAGE = {
    "black": (
        lambda t: with_image(t, FRONT, 3, image(np.zeros((SIZE, SIZE, 3), np.uint8))),
        "frame 3.*black",
    ),
    "size": (
        lambda t: with_image(t, FRONT, 2, image(np.eye(20, dtype=np.uint8)[..., None])),
        "20 × 20",
    ),
    "repeated": (lambda t: with_image(t, FRONT, 2, 1), "frame 2.*identical to the previous image"),
    "no image": (
        lambda t: with_image(t, FRONT, 1, {"bytes": b"PNG", "path": "x"}),
        "cannot be decoded",
    ),
    "depth": (
        lambda t: with_image(t, DEPTH, 0, image(np.full((SIZE, SIZE, 1), np.nan, np.float32))),
        "frame 0.*not finite and positive",
    ),
    "nan": (
        lambda t: with_value(t, names.STATE, 4, [float("nan")] * 7),
        "observation.state: 1 frames.*first 4",
    ),
    "order": (lambda t: with_value(t, "index", 4, 9), "index: not 0, 1, 2"),
    "frame": (lambda t: with_value(t, "frame_index", 2, 0), "episode 0: frame_index"),
    "done": (lambda t: with_value(t, names.DONE, 0, True), "episode 0: next.done"),
    "seed": (lambda t: with_value(t, names.SEED, 0, 77), "different seeds"),
    "statistics": (
        lambda t: with_value(t, names.REWARD, 0, -50.0),
        "min of next.reward does not match",
    ),
    "content": (lambda t: with_value(t, names.ACTION, 0, [0.1] * 7), "digest: the content has"),
}


def test_a_good_dataset_has_no_problems(tmp_path, fake, demos):
    summary = render(demos, tmp_path / "set", segmentation=True)
    report = check_dataset(tmp_path / "set")
    assert report.problems == ()
    assert (report.ok, report.frames, report.episodes, report.digest) == (
        True,
        summary.frames,
        3,
        summary.digest,
    )


def huge_png(side):
    """A PNG of a few bytes whose header promises `side` × `side` pixels."""

    def chunk(kind, content):
        checksum = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"0")), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize("side", [9_000, 60_000])
def test_a_huge_image_is_refused_before_it_is_decoded(side, monkeypatch):
    monkeypatch.setattr(codecs.cv2, "imdecode", None)
    with pytest.raises(BadFile, match="x: its image has over 67108864 pixels"):
        codecs.decode(huge_png(side), "x")


def test_an_image_whose_size_only_opencv_can_read_is_refused(monkeypatch):
    image = np.full((8, 8, 3), 0.5, np.float32)
    content = cv2.imencode(".hdr", image)[1].tobytes()
    monkeypatch.setattr(codecs.cv2, "imdecode", None)
    with pytest.raises(BadFile, match="x: its image cannot be decoded"):
        codecs.decode(content, "x")


BAD_STATISTICS = {
    "text": {"mean": "x"},
    "table": {"std": {"a": 1}},
    "huge": {"max": [10**400]},
}


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("info", []),
        ("info", {"features": None}),
        ("stats", [1]),
        *(("stats", {names.ACTION: wrong}) for wrong in BAD_STATISTICS.values()),
    ],
)
def test_check_reports_metadata_of_other_types(tmp_path, fake, demos, file, content):
    render(demos, tmp_path / "set", depth=False)
    (tmp_path / f"set/meta/{file}.json").write_text(json.dumps(content))
    problems = check_dataset(tmp_path / "set").problems
    assert any(re.search(f"meta/{file}.json", problem) for problem in problems), problems
    assert not any("\n" in problem for problem in problems)


@pytest.mark.parametrize("name", DAMAGE)
def test_check_finds_damage(tmp_path, fake, demos, name):
    render(demos, tmp_path / "set")
    change, message = DAMAGE[name]
    rewrite(tmp_path / "set/data/chunk-000/file-000.parquet", change)
    report = check_dataset(tmp_path / "set")
    assert any(re.search(message, problem) for problem in report.problems), report.problems
    assert not any("\n" in problem for problem in report.problems)


def test_check_finds_damaged_metadata(tmp_path, fake, demos):
    render(demos, tmp_path / "set")
    info = tmp_path / "set/meta/info.json"
    info.write_text(info.read_text().replace('"total_episodes": 3', '"total_episodes": 4'))
    assert (
        "meta/info.json: its counts differ from the data."
        in check_dataset(tmp_path / "set").problems
    )
    info.write_text(info.read_text().replace('"fps": 50', '"fps": 10'))
    assert "meta/info.json: its fps is not 50." in check_dataset(tmp_path / "set").problems
    tasks = tmp_path / "set/meta/tasks.parquet"
    pq.write_table(pq.read_table(tasks).slice(1), tasks)
    assert "meta/tasks.parquet: it holds no task." in check_dataset(tmp_path / "set").problems
    tasks.unlink()
    assert any(
        "LeRobot's metadata cannot be read" in line
        for line in check_dataset(tmp_path / "set").problems
    )
    (tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").write_bytes(b"")
    assert any(
        "LeRobot's metadata cannot be read" in line
        for line in check_dataset(tmp_path / "set").problems
    )


# -- the real environment --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two demonstrations of the expert, recorded by two worker processes."""
    out = tmp_path_factory.mktemp("real") / "demos"
    record(TaskConfig("place"), episodes=2, out=out, context=RunContext(2))
    return out


def test_recording_does_not_depend_on_the_workers(tmp_path, recorded):
    again = record(TaskConfig("place"), episodes=2, out=tmp_path / "demos", context=RunContext(0))
    assert [path.read_bytes() for path in again] == [
        path.read_bytes() for path in list_demos(recorded)
    ]


def test_rendering_does_not_depend_on_the_workers_and_equals_what_was_seen_live(tmp_path, recorded):
    views = ("front", "endo_left_psm2")
    options = {"views": views, "size": 64, "depth": True, "segmentation": True}
    spawned = render_demos(recorded, tmp_path / "spawned", context=RunContext(2), **options)
    inline = render_demos(recorded, tmp_path / "inline", context=RunContext(0), **options)
    dataset = open_dataset(tmp_path / "spawned")
    assert (spawned.frames, spawned.digest) == (inline.frames, inline.digest)
    assert dataset.fingerprint == open_dataset(tmp_path / "inline").fingerprint
    assert check_dataset(tmp_path / "spawned").problems == ()
    # Live: the same seed and recorded actions, with the observations read on the way.
    demo = read_demo(list_demos(recorded)[1])
    shown = {"obs_type": "pixels_agent_pos", "image_size": 64, "depth": True, "segmentation": True}
    env = envs.make(demo.config, cameras=views, **shown)
    observation, _ = env.reset(seed=demo.seed)
    row = int(np.flatnonzero(dataset.episode_index == 1)[0])
    columns = dataset.columns()
    for step, action in enumerate(demo.action):
        for view in views:
            frame = row + step
            np.testing.assert_array_equal(
                dataset.frames(view, frame, frame + 1)[0], observation[view]
            )
            np.testing.assert_array_equal(
                dataset.depth(view, frame, frame + 1)[0], observation[f"{view}_depth"]
            )
            parts = dataset.segmentation(view, frame, frame + 1)[0]
            np.testing.assert_array_equal(parts, observation[f"{view}_segmentation"])
        np.testing.assert_array_equal(columns[names.STATE][row + step], observation["agent_pos"])
        observation, reward, *_, info = env.step(action)
        assert columns[names.REWARD][row + step] == np.float32(reward)
        assert columns[names.SUCCESS][row + step] == info["is_success"]
    env.close()


def test_a_dataset_has_the_calibration_of_every_view(tmp_path, recorded):
    views = ("back", "wrist_psm2", "back_psm2")
    render_demos(recorded, tmp_path / "set", views=views, size=32, context=RunContext(0))
    dataset = open_dataset(tmp_path / "set")
    assert set(dataset.meta["cameras"]) == set(dataset.views) == set(views)
    assert dataset.meta["cameras"]["back_psm2"]["camera"] == "back"
    # Vertical field of view 0.8 rad on 32 pixels.
    whole = dataset.intrinsics("back")
    np.testing.assert_allclose(whole[0, 1, 1], 16 / np.tan(0.4), rtol=1e-3)
    assert (whole == whole[0]).all()
    stands = dataset.extrinsics("back")
    np.testing.assert_allclose(stands[0, :3, 3], [0, -0.0359, 0.1659], atol=1e-6)
    assert (stands == stands[0]).all()
    assert (dataset.extrinsics("back_psm2") == stands).all(), "a crop stands where its camera does"
    moving = dataset.extrinsics("wrist_psm2")
    assert not np.array_equal(moving[0], moving[-1]), "it moves with the arm"
    window = dataset.intrinsics("back_psm2")
    assert (window[:, :2, 2] != window[0, :2, 2]).any(), "the window follows the arm"
    assert dataset.meta["renderers"][0]


def test_the_calibration_of_a_frame_is_that_of_its_state(tmp_path, recorded):
    views = ("front_psm2", "wrist_psm2")
    render_demos(recorded, tmp_path / "set", views=views, size=32, context=RunContext(0))
    dataset = open_dataset(tmp_path / "set")
    demo = read_demo(list_demos(recorded)[0])
    env = envs.make(demo.config)
    for frame in (0, len(demo) - 1):
        env.set_state_vector(demo.state[frame])
        for view in views:
            K = env.calibration.intrinsics(view, (32, 32)).astype(np.float32)
            np.testing.assert_array_equal(dataset.intrinsics(view)[frame], K)
            pose = env.calibration.extrinsics(view).astype(np.float32)
            np.testing.assert_array_equal(dataset.extrinsics(view)[frame], pose)
    with pytest.raises(UnknownName, match="view of this dataset"):
        dataset.intrinsics("back")


KILLED = """
import sys
from pathlib import Path
from contextlib import contextmanager
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import render_demos

@contextmanager
def stage(title, unit):
    yield lambda *row: print(*row, flush=True)

if __name__ == "__main__":
    demos, out = map(Path, sys.argv[1:])
    render_demos(demos, out, size=64, context=RunContext(1, stage=stage))
"""


@pytest.mark.parametrize("moment", ["first episode", "between", "assembling"])
def test_killed_rendering_continues_to_the_same_dataset(tmp_path, recorded, moment):
    """SIGKILL while rendering and at the end; `benchmarks/kill.py` does it at random moments."""
    script = tmp_path / "script.py"
    script.write_text(KILLED)
    process = subprocess.Popen(
        [sys.executable, script, recorded, tmp_path / "set"], stdout=subprocess.PIPE, text=True
    )
    lines = {"first episode": 1, "between": 2, "assembling": 3}[moment]
    for _ in range(lines):
        process.stdout.readline()
    process.kill()
    process.wait(10)
    assert not (tmp_path / "set").exists()
    seen = []
    shown = showing(lambda *row: seen.append(row[0]))
    options = {"size": 64, "context": RunContext(0, stage=shown)}
    again = render_demos(recorded, tmp_path / "set", **options)
    assert bool(seen[0]) == (lines > 1), "what was finished is not done again"
    assert (
        again.digest
        == render_demos(recorded, tmp_path / "whole", size=64, context=RunContext(0)).digest
    )
    assert (
        open_dataset(tmp_path / "set").fingerprint == open_dataset(tmp_path / "whole").fingerprint
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["script.py", "set", "whole"]
