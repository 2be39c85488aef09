"""Repair: the longest whole prefix of a broken LeRobot dataset, ours or anyone's."""

import errno
import json
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_demos import render_with_fake_env, write_demos
from lerobot_salvage.main import main
from lerobot_salvage.recovery import LEROBOT, Writing, recover
from lerobot_salvage.repair import _exchange

import surgicai_vision.dataset
from lerobot_salvage import check_dataset, repair_dataset, thrift
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, OutputExists
from surgicai_vision.core.executor import RunContext, work_folder
from surgicai_vision.core.executor.store import LOCK
from surgicai_vision.core.files import locked
from surgicai_vision.dataset import codecs, render_demos
from surgicai_vision.dataset.lerobot_files import TASKS, LeRobotFiles
from surgicai_vision.dataset.stats import ImageStatistics

CAMERA, DATA = "observation.images.cam", "data/chunk-000/file-000.parquet"
LENGTHS = (6, 4, 5)
CONFIG = TaskConfig(max_steps=12)


@pytest.fixture(autouse=True)
def offline(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))


def write_lerobot(root, video=False, **options):
    """Write a foreign dataset of three episodes and two tasks; return it before `finalize`."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    plain = {"dtype": "float32", "names": None}
    features = {
        CAMERA: {
            "dtype": "video" if video else "image",
            "shape": (48, 64, 3),
            "names": ["height", "width", "channels"],
        },
        names.STATE: {**plain, "shape": (4,)},
        "grid": {**plain, "shape": (2, 3)},
        "ok": {"dtype": "bool", "shape": (1,), "names": None},
        "note": {"dtype": "string", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("local/x", 20, features, root=root, use_videos=video, **options)
    rng = np.random.default_rng(0)
    for episode, length in enumerate(LENGTHS):
        for _ in range(length):
            frame = {
                CAMERA: rng.integers(0, 255, (48, 64, 3), dtype=np.uint8),
                names.STATE: rng.normal(size=4).astype(np.float32),
                "grid": rng.normal(size=(2, 3)).astype(np.float32),
                "ok": np.array([True]),
                "note": "text",
                "task": f"task {episode % 2}",
            }
            dataset.add_frame(frame)
        dataset.save_episode(parallel_encoding=False)
    return dataset


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """A whole foreign dataset, and what a SIGKILL before `finalize` leaves of it."""
    folder = tmp_path_factory.mktemp("foreign")
    dataset = write_lerobot(folder / "whole")
    shutil.copytree(folder / "whole", folder / "killed")
    dataset.finalize()
    return folder


def opened(path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("local/x", root=path, video_backend="pyav")


def files(folder):
    return [path for path in folder.rglob("*") if path.is_file()]


def same_items(one, other, count):
    for index in range(count):
        left, right = one[index], other[index]
        assert left.keys() == right.keys()
        for key, value in left.items():
            if hasattr(value, "numpy"):
                np.testing.assert_array_equal(value.numpy(), right[key].numpy(), err_msg=key)
            else:
                assert value == right[key], key


def test_what_lerobots_writer_loses_when_killed_is_kept(tmp_path, foreign):
    killed = shutil.copytree(foreign / "killed", tmp_path / "set")
    report = check_dataset(killed)
    assert (
        "data/chunk-000/file-000.parquet has no footer: its writer was killed." in report.problems
    )
    assert "meta/episodes is missing." in report.problems
    before = {path: path.read_bytes() for path in files(killed)}
    repair = repair_dataset(killed)
    assert (repair.episodes, repair.claimed, repair.frames) == (3, 3, sum(LENGTHS))
    assert check_dataset(killed).problems == ()
    assert repair.original == tmp_path / "set.broken"
    kept = {
        killed / path.relative_to(repair.original): path.read_bytes()
        for path in files(repair.original)
    }
    assert kept == before, "the original is as it was"
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "cache") == [
        "set",
        "set.broken",
    ]
    mended, whole = opened(killed), opened(foreign / "whole")
    assert mended.num_episodes == 3
    same_items(mended, whole, sum(LENGTHS))
    for key, statistics in whole.meta.stats.items():
        for name in ("min", "max", "mean", "std", "count"):
            # LeRobot's own std of images is 4e-5 off numpy's.
            np.testing.assert_allclose(
                mended.meta.stats[key][name], statistics[name], atol=1e-4, err_msg=key
            )


def test_a_video_dataset_is_repaired_by_counting_its_frames(tmp_path):
    dataset = write_lerobot(tmp_path / "whole", video=True)
    shutil.copytree(tmp_path / "whole", tmp_path / "set")
    dataset.finalize()
    repair = repair_dataset(tmp_path / "set", tmp_path / "mended")
    assert repair.episodes == 3
    assert repair.original == tmp_path / "set"
    assert check_dataset(tmp_path / "mended").problems == ()
    mended = opened(tmp_path / "mended")
    assert mended[sum(LENGTHS) - 1][CAMERA].shape == (3, 48, 64)
    row = mended.meta.episodes[2]
    np.testing.assert_allclose(row[f"videos/{CAMERA}/from_timestamp"], sum(LENGTHS[:2]) / 20)


def change(path, column, row, value):
    values = pq.read_table(path).column(column).to_pylist()
    values[row] = value
    replace(path, column, values)


def replace(path, column, values):
    table = pq.read_table(path)
    field = table.field(column)
    table = table.set_column(
        table.schema.get_field_index(column), field, pa.array(values, field.type)
    )
    pq.write_table(table, path)


def counts_more(folder):
    info = json.loads((folder / "meta/info.json").read_text())
    info.update(total_episodes=8, total_frames=99)
    (folder / "meta/info.json").write_text(json.dumps(info))


def fewer_rows(folder):
    path = next(folder.glob("meta/episodes/*/*.parquet"))
    pq.write_table(pq.read_table(path).slice(0, 2), path)


def torn(folder):
    """The last episode's row group is half on disk."""
    path = folder / DATA
    last = pq.ParquetFile(path).metadata.row_group(2).column(0)
    start = last.dictionary_page_offset or last.data_page_offset
    path.write_bytes(path.read_bytes()[: start + 3000])


def unfinished(folder):
    """The last eight bytes are missing: the footer is there, but not where it is."""
    path = folder / DATA
    path.write_bytes(path.read_bytes()[:-8])


def counts_in_words(folder):
    info = json.loads((folder / "meta/info.json").read_text())
    info["total_episodes"] = "many"
    (folder / "meta/info.json").write_text(json.dumps(info))


DAMAGE = {
    "more counted": (counts_more, 3, "it counts 8 episodes"),
    "no number counted": (counts_in_words, 3, "it counts many episodes"),
    "rows missing": (fewer_rows, 3, "rows do not match the episodes"),
    "torn": (torn, 2, "no footer"),
    "unfinished": (unfinished, 3, "no footer"),
    "image spoilt": (
        lambda f: change(f / DATA, CAMERA, 8, {"bytes": b"no", "path": "x"}),
        1,
        "cannot be decoded",
    ),
    "image missing": (
        lambda f: change(f / DATA, CAMERA, 8, {"bytes": None, "path": "x.png"}),
        1,
        "x.png is missing",
    ),
    "path outside": (
        lambda f: change(f / DATA, CAMERA, 8, {"bytes": None, "path": "/etc/passwd"}),
        1,
        "passwd is missing",
    ),
    "gap": (lambda f: change(f / DATA, "frame_index", 12, 9), 2, "its frame_index is"),
    "nan": (lambda f: change(f / DATA, names.STATE, 12, [float("nan")] * 4), 2, "not finite"),
    "statistics": (
        lambda f: (f / "meta/stats.json").write_text("{"),
        3,
        "stats.json is not valid JSON",
    ),
    "tasks": (lambda f: (f / TASKS).unlink(), 3, "tasks.parquet cannot be read"),
    "task index": (lambda f: change(f / TASKS, "task_index", 1, 10**12), 3, "not within 0 and"),
    "task of a frame": (lambda f: change(f / DATA, "task_index", 8, 10**12), 1, "its task_index"),
    "task below 0": (lambda f: change(f / DATA, "task_index", 8, -1), 1, "its task_index"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_the_longest_whole_prefix_of_a_foreign_dataset_is_kept(tmp_path, foreign, name):
    spoil, kept, message = DAMAGE[name]
    folder = shutil.copytree(foreign / "whole", tmp_path / "set")
    assert check_dataset(folder).ok
    spoil(folder)
    problems = check_dataset(folder).problems
    assert any(message in problem for problem in problems), problems
    repair = repair_dataset(folder)
    assert repair.episodes == kept
    assert check_dataset(folder).problems == ()
    mended = opened(folder)
    assert mended.num_episodes == kept
    if name != "tasks":
        same_items(mended, opened(foreign / "whole"), sum(LENGTHS[:kept]))


@pytest.mark.parametrize("spoil", [lambda f: None, DAMAGE["tasks"][0]], ids=["kept", "lost"])
def test_every_task_index_of_the_data_gets_a_task(tmp_path, foreign, spoil):
    folder = shutil.copytree(foreign / "whole", tmp_path / "set")
    change(folder / DATA, "task_index", 5, 3)
    spoil(folder)
    problems = check_dataset(folder).problems
    assert any("no task for" in problem for problem in problems), problems
    assert repair_dataset(folder).episodes == 3
    assert check_dataset(folder).problems == ()
    mended = opened(folder)
    assert mended.meta.total_tasks == 4
    assert [mended[index]["task"] for index in (4, 5, 6)] == ["task 0", "task 3", "task 1"]


def describe(folder, key, **changes):
    """Change what `info.json` says of a feature."""
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][key].update(changes)
    (folder / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"shape": [2_000_000_000]}, "the shape of observation.state"),
        ({"shape": [100_000, 100_000]}, "the shape of observation.state"),
        ({"shape": [0]}, "the shape of observation.state"),
        ({"shape": [-2, -2]}, "the shape of observation.state"),
        ({"shape": []}, "the shape of observation.state"),
        ({"shape": [1] * 2000}, "the shape of observation.state"),
        ({"shape": [float("inf")]}, "infinity"),
        ({"shape": [2**25]}, "numbers besides images"),
        ({"info": "x"}, "info of observation.state is 'x'"),
    ],
)
def test_a_feature_that_cannot_be_is_refused(tmp_path, foreign, changes, said):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")
    describe(folder, names.STATE, **changes)
    for work in (check_dataset, repair_dataset):
        with pytest.raises(BadFile, match=f"does not describe a LeRobot dataset.*{said}"):
            work(folder)


@pytest.mark.parametrize("key", ["../../outside", "observation.images.a/b"])
def test_a_feature_whose_name_is_a_path_is_refused(tmp_path, foreign, key):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][key] = {**info["features"][CAMERA], "dtype": "video"}
    (folder / "meta/info.json").write_text(json.dumps(info))
    for work in (check_dataset, repair_dataset):
        with pytest.raises(BadFile, match=f"the feature's name '{key}' contains a /"):
            work(folder)


@pytest.mark.parametrize(
    ("column", "value"), [("from_timestamp", float("inf")), ("chunk_index", None)]
)
def test_a_place_in_the_videos_that_is_no_number_ends_the_prefix(tmp_path, column, value):
    write_lerobot(tmp_path / "set", video=True).finalize()
    rows = next(tmp_path.glob("set/meta/episodes/*/*.parquet"))
    change(rows, f"videos/{CAMERA}/{column}", 1, value)
    problems = check_dataset(tmp_path / "set").problems
    assert f"episode 1: its place in the videos of {CAMERA} is not numbers." in problems
    assert repair_dataset(tmp_path / "set").episodes == 1


def test_a_place_before_a_depth_video_ends_the_prefix(tmp_path):
    write_lerobot(tmp_path / "set", video=True).finalize()
    describe(tmp_path / "set", CAMERA, info={"is_depth_map": True})
    rows = next(tmp_path.glob("set/meta/episodes/*/*.parquet"))
    change(rows, f"videos/{CAMERA}/from_timestamp", 1, -0.2)
    problems = check_dataset(tmp_path / "set").problems
    said = f"episode 1: its place in the videos of {CAMERA} is before their beginning."
    assert said in problems


def test_rows_of_other_lengths_end_the_prefix(tmp_path, foreign):
    folder = shutil.copytree(foreign / "whole", tmp_path / "set")
    table = pq.read_table(folder / DATA)
    index = table.schema.get_field_index(names.STATE)
    states = table.column(names.STATE).to_pylist()
    states[LENGTHS[0]], states[LENGTHS[0] + 1] = [0.0] * 3, [0.0] * 5  # of 4 values each
    lists = pa.array(states, pa.list_(pa.float32()))
    pq.write_table(table.set_column(index, names.STATE, lists), folder / DATA)
    said = f"episode 1: {names.STATE} has rows that are not of shape (4,)."
    assert said in check_dataset(folder).problems
    assert repair_dataset(folder).episodes == 1


def test_large_images_and_an_empty_info_are_allowed(tmp_path, foreign):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")
    describe(folder, CAMERA, shape=[2160, 3840, 3], info=None)
    assert LeRobotFiles(folder).features[CAMERA]["shape"] == (2160, 3840, 3)


def test_grey_images_are_checked_and_repaired(tmp_path, foreign):
    folder = shutil.copytree(foreign / "whole", tmp_path / "set")
    frames = np.random.default_rng(1).integers(0, 256, (sum(LENGTHS), 48, 64, 1), dtype=np.uint8)
    images = [cv2.imencode(".png", frame)[1].tobytes() for frame in frames]
    replace(folder / DATA, CAMERA, [{"bytes": image, "path": "x"} for image in images])
    describe(folder, CAMERA, shape=[48, 64, 1])
    assert check_dataset(folder).problems == ()
    counts_more(folder)
    assert repair_dataset(folder).episodes == 3
    mended = opened(folder)
    np.testing.assert_allclose(mended.meta.stats[CAMERA]["mean"], [[[frames.mean() / 255]]])
    np.testing.assert_allclose(mended[7][CAMERA].numpy(), frames[7, ..., 0][None] / 255, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("channels", [1, 3])
def test_statistics_have_the_channels_of_the_images(channels, dtype):
    statistics = ImageStatistics()
    frame = np.broadcast_to(np.arange(channels), (8, 8, channels)).astype(dtype)
    statistics.add(frame)
    statistics.add(frame)
    scale = 255 if dtype == np.uint8 else 1
    np.testing.assert_allclose(
        statistics.result()["max"], np.arange(channels)[:, None, None] / scale
    )


def test_images_beside_the_data_are_taken_in(tmp_path, foreign):
    folder = shutil.copytree(foreign / "whole", tmp_path / "set")
    content = pq.read_table(folder / DATA).column(CAMERA)[3].as_py()["bytes"]
    (folder / "images").mkdir(exist_ok=True)
    (folder / "images/a.png").write_bytes(content)
    change(folder / DATA, CAMERA, 3, {"bytes": None, "path": "images/a.png"})
    counts_more(folder)
    assert repair_dataset(folder).episodes == 3
    same_items(opened(folder), opened(foreign / "whole"), sum(LENGTHS))


def test_a_whole_dataset_is_left_alone(tmp_path, foreign):
    repair = repair_dataset(foreign / "whole", tmp_path / "out")
    assert (repair.original, repair.problems) == (None, ())
    assert not (tmp_path / "out").exists()
    assert not list(foreign.glob("whole.*"))


def test_nothing_whole_is_one_line_and_changes_nothing(tmp_path, foreign):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")
    (folder / DATA).write_bytes(b"PAR1")
    with pytest.raises(BadFile, match="no episode is complete"):
        repair_dataset(folder)
    assert [path.name for path in tmp_path.iterdir() if path.name != "cache"] == ["set"]
    with pytest.raises(BadFile, match="which nothing can be read"):
        repair_dataset(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    with pytest.raises(InputError, match="a link or a mount point"):
        repair_dataset(folder, tmp_path / "link")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/note").write_text("mine")
    with pytest.raises(OutputExists):
        repair_dataset(folder, tmp_path / "full")


@pytest.mark.parametrize("name", [".", ".."])
def test_the_current_folder_is_repaired_only_into_another(
    tmp_path, foreign, monkeypatch, name, capsys
):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")
    (folder / "below").mkdir()
    monkeypatch.chdir(folder if name == "." else folder / "below")
    assert main(["repair", name]) == 2
    assert "give --out DIR" in capsys.readouterr().err
    assert main(["repair", name, "--out", str(tmp_path / "mended")]) == 0


def test_a_second_repair_is_refused_and_leaves_the_first_ones_work(tmp_path, foreign):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")
    work = work_folder(folder)
    work.mkdir()
    (work / "half").write_text("of the first")
    with locked(work / LOCK), pytest.raises(InputError, match="Another run is working"):
        repair_dataset(folder)
    assert (work / "half").read_text() == "of the first"
    assert repair_dataset(folder).episodes == 3, "the first one was killed"
    assert not work.exists()


def test_a_dataset_in_another_layout_is_treated_as_anyones(tmp_path, foreign):
    folder = shutil.copytree(foreign / "whole", tmp_path / "set")
    meta = {
        "format": 3,
        "layout": "open-h",
        "request": {"size": 48},
        "views": ["back"],
        "depth": False,
        "segmentation": False,
        "image_size": 48,
        "frames": sum(LENGTHS),
        "episodes": 3,
        "digest": "0" * 64,
    }
    (folder / names.META_FILE).write_text(json.dumps(meta))
    assert check_dataset(folder).problems == ()
    assert repair_dataset(folder).original is None
    DAMAGE["image spoilt"][0](folder)
    assert repair_dataset(folder).episodes == 1
    assert check_dataset(folder).problems == ()
    assert json.loads((folder / names.META_FILE).read_text()) == {
        **meta,
        "request": None,
        "repaired": {"episodes_before": 3, "digest_before": meta["digest"]},
        "frames": LENGTHS[0],
        "episodes": 1,
        "digest": None,
    }


@pytest.fixture
def ours(tmp_path, monkeypatch):
    render_with_fake_env(monkeypatch, CONFIG)
    folder = write_demos(tmp_path / "demos", CONFIG, (1, 2, 4))
    render_demos(
        folder, tmp_path / "set", size=32, depth=True, segmentation=True, context=RunContext(0)
    )
    return tmp_path / "set"


def black(folder):
    frame = {"bytes": codecs.encode(np.zeros((32, 32, 3), np.uint8)), "path": "x"}
    table = pq.read_table(folder / DATA)
    change(folder / DATA, names.image_key("back"), len(table) - 1, frame)


def cut(folder):
    path = folder / DATA
    path.write_bytes(path.read_bytes()[:-20])


@pytest.mark.parametrize(("spoil", "kept"), [(cut, 3), (black, 2), (counts_more, 3)])
def test_a_dataset_of_ours_is_repaired(tmp_path, ours, spoil, kept):
    spoil(ours)
    repair = repair_dataset(ours)
    assert repair.episodes == kept
    report = check_dataset(ours)
    assert (report.ok, report.episodes) == (True, kept)
    assert opened(ours).num_episodes == kept
    with pytest.raises(OutputExists):  # it is no longer what the command made
        render_demos(
            tmp_path / "demos", ours, size=32, depth=True, segmentation=True, context=RunContext(0)
        )


def test_a_video_dataset_of_ours_is_repaired(tmp_path, monkeypatch):
    render_with_fake_env(monkeypatch, CONFIG)
    folder = write_demos(tmp_path / "demos", CONFIG, (1, 2, 4))
    options = {"size": 32, "video": "h264", "context": RunContext(0)}
    render_demos(folder, tmp_path / "set", views=("back",), **options)
    row = tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(row).slice(0, 1), row)
    assert repair_dataset(tmp_path / "set").episodes == 3
    assert check_dataset(tmp_path / "set").problems == ()


def test_the_command_line_checks_and_repairs(tmp_path, foreign, capsys):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")
    assert main(["check", str(folder)]) == 1
    assert "`lerobot-salvage repair` keeps what is whole" in capsys.readouterr().out
    assert main(["repair", str(folder), "--out", str(tmp_path / "mended"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["episodes"], result["path"]) == (3, str(tmp_path / "mended"))
    assert main(["check", str(tmp_path / "mended"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["ok"]
    for wrong in (["check"], ["mend", str(folder)], ["check", str(tmp_path / "none")]):
        assert main(wrong) == 2
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "The disk is full"),
        (PermissionError(errno.EACCES, "Permission denied", "set.work"), "set.work: Permission"),
    ],
    ids=["full", "not allowed"],
)
def test_an_error_of_the_disk_is_one_line(tmp_path, foreign, capsys, monkeypatch, error, said):
    folder = shutil.copytree(foreign / "killed", tmp_path / "set")

    def refuse(*_):
        raise error

    monkeypatch.setattr("lerobot_salvage.repair.write_metadata", refuse)
    assert main(["repair", str(folder)]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"lerobot-salvage: error: {said}")


def test_the_command_is_installed():
    command = Path(sys.executable).with_name("lerobot-salvage")
    result = subprocess.run([command, "--version"], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["lerobot-salvage", version("lerobot_salvage")]


def test_our_own_check_names_the_command_for_other_datasets(foreign):
    with pytest.raises(BadFile, match="lerobot-salvage check"):
        surgicai_vision.dataset.check_dataset(foreign / "whole")


def test_two_folders_swap_names(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    assert _exchange(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a/b").exists()
    assert (tmp_path / "b/a").exists()


def table(count, first=0):
    rng = np.random.default_rng(first)
    image = [{"bytes": rng.bytes(9000), "path": f"{index}"} for index in range(count)]
    return pa.table(
        {
            "image": pa.array(image, pa.struct({"bytes": pa.binary(), "path": pa.string()})),
            "vector": pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=count * 7)), 7),
            "grid": pa.array(
                rng.normal(size=(count, 2, 3)).tolist(), pa.list_(pa.list_(pa.float64()))
            ),
            "done": pa.array(np.arange(count) == count - 1),
            "index": pa.array(np.arange(first, first + count)),
        }
    )


@pytest.mark.parametrize("writing", [LEROBOT, Writing("zstd", False)])
def test_footerless_parquet_is_read_up_to_the_last_whole_row_group(tmp_path, writing):
    parts, sizes = [], []
    writer = pq.ParquetWriter(
        tmp_path / "whole",
        table(1).schema,
        compression=writing.compression,
        use_dictionary=writing.dictionary,
    )
    for count in (150, 1, 7, 300):
        parts.append(table(count, sum(map(len, parts))))
        writer.write_table(parts[-1])
        sizes.append((tmp_path / "whole").stat().st_size)
    content = (tmp_path / "whole").read_bytes()
    for size, groups in (
        (sizes[3], 4),
        (sizes[3] - 1, 3),
        (sizes[1] + 5000, 2),
        (sizes[0] - 3, 0),
        (3, 0),
        (0, 0),
    ):
        (tmp_path / "cut").write_bytes(content[:size])
        assert (
            recover(tmp_path / "cut", parts[0].slice(0, 1), tmp_path / "mended", writing) == groups
        )
        if groups:
            assert pq.read_table(tmp_path / "mended").equals(pa.concat_tables(parts[:groups]))
    writer.close()


def test_thrift_round_trip_and_rubbish():
    fields = {
        1: (thrift.I32, -5),
        2: (thrift.BINARY, b"abc"),
        3: (thrift.TRUE, True),
        20: (thrift.LIST, (thrift.I64, list(range(-20, 20)))),
        21: (
            thrift.STRUCT,
            {1: (thrift.DOUBLE, 0.5), 2: (thrift.FALSE, False), 300: (thrift.I64, 2**60)},
        ),
    }
    content = thrift.write_struct(fields)
    assert thrift.read_struct(content, 0) == (fields, len(content))
    rng = np.random.default_rng(0)
    for _ in range(300):
        try:
            thrift.read_struct(rng.bytes(60), 0)
        except ValueError:
            continue
