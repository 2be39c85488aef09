"""LeRobot datasets from elsewhere, v2.1 and v3, become demonstrations of the same motion."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.demos.imports import lerobot_dataset
from surgicai_vision.demos.imports.lerobot_dataset import import_dataset
from surgicai_vision.demos.imports.rosbag.config import BagConfig, Frames
from surgicai_vision.demos.record import record
from surgicai_vision.demos.store import Demo, list_demos, read_demo
from surgicai_vision.envs import poses

AS_RECORDED = BagConfig(drop_pauses=False)
Rows = dict[str, list[Any]]
STILL: Rows = {
    names.STATE: [[0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0, 0.0] * 2] * 60,
    "instruction.text": ["Needle Throw"] * 60,
    "phase": [1] * 60,
    "episode_index": [0] * 60,
    "frame_index": list(range(60)),
    "timestamp": [frame / names.FPS for frame in range(60)],
    "task_index": [0] * 60,
}
"""Arms that stand still."""


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> list[Demo]:
    """Two demonstrations of place that go on for a moment after their success."""
    folder = tmp_path_factory.mktemp("import-dataset") / "demos"
    record(TaskConfig("place"), episodes=2, out=folder, post_success_steps=5, context=RunContext(0))
    return [read_demo(path) for path in list_demos(folder)]


def rows_of(demo: Demo, episode: int) -> Rows:
    """Return the dataset rows of a demonstration; each frame is the state before an action."""
    env = envs.make(demo.config)
    rows: Rows = {names.STATE: [], names.NEEDLE_POSE: []}
    for state in demo.state[:-1]:
        env.set_state_vector(state)
        rows[names.STATE].append(env.absolute_pos().tolist())
        rows[names.NEEDLE_POSE].append(env.needle_pose().tolist())
    count = len(demo)
    return {
        **rows,
        "instruction.text": ["Needle Throw"] * count,
        "phase": [1] * count,
        "episode_index": [episode] * count,
        "frame_index": list(range(count)),
        "timestamp": (np.arange(count) / names.FPS).astype(np.float32).tolist(),
        "task_index": [0] * count,
    }


def write_dataset(
    folder: Path,
    episodes: Sequence[Rows],
    version: str = "v3.0",
    state_names: object = (list(names.ABSOLUTE_STATE_NAMES),),
    task: str = names.TASK_TEXTS["place"],
) -> Path:
    """Write rows as a LeRobot dataset without images."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    features: dict[str, Mapping[str, object]] = {
        key: {"dtype": "int64", "shape": [1], "names": None} for key in episodes[0]
    }
    features[names.STATE] = {"dtype": "float32", "shape": [16], "names": state_names}
    info = {"codebase_version": version, "fps": names.FPS, "features": features}
    (folder / names.INFO_FILE).write_text(json.dumps(info))
    if version == "v2.1":
        for number, rows in enumerate(episodes):
            file = folder / f"data/chunk-000/episode_{number:06d}.parquet"
            pq.write_table(pa.table(rows), file)
        (folder / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": task}) + "\n")
    else:
        table = pa.concat_tables([pa.table(rows) for rows in episodes])
        pq.write_table(table, folder / "data/chunk-000/file-000.parquet", row_group_size=50)
        index = pandas.Index([task], name="task")
        pandas.DataFrame({"task_index": [0]}, index=index).to_parquet(folder / "meta/tasks.parquet")
    return folder


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_arms_and_needle_are_where_they_were(
    demos: list[Demo], tmp_path: Path, version: str
) -> None:
    rows = [rows_of(demo, number) for number, demo in enumerate(demos)]
    path = write_dataset(tmp_path / "dataset", rows, version)
    (made,) = import_dataset(path, task=None, out=tmp_path / "out", config=AS_RECORDED)
    assert (made.task, len(made.paths), made.succeeded, made.skipped) == ("place", 2, 2, ())
    assert made.out == tmp_path / "out" / "place"
    env = envs.make(demos[0].config)
    for path_made, original in zip(made.paths, demos, strict=True):
        demo = read_demo(path_made)
        assert demo.demonstrator == "dataset"
        assert len(demo) == len(original) - 1, "the last frame is the last state"
        for state, recorded in zip(demo.state, original.state, strict=False):
            env.set_state_vector(recorded)
            wanted = {arm: env.simulation.tip(arm) for arm in names.ARMS}
            needle = env.needle_pose()
            env.set_state_vector(state)
            for arm, tip in wanted.items():
                assert poses.distance(env.simulation.tip(arm), tip) < 1e-6
                assert poses.angle(env.simulation.tip(arm), tip) < 1e-4
            np.testing.assert_allclose(env.needle_pose(), needle, atol=1e-5)


def test_the_same_import_finds_it_finished(demos: list[Demo], tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "dataset", [rows_of(demos[0], 0)])
    first = import_dataset(path, task="place", out=tmp_path / "out")
    again = import_dataset(path, task="place", out=tmp_path / "out")
    assert first == again
    assert first[0].out == tmp_path / "out"


def test_episodes_that_do_not_show_the_task_are_skipped(demos: list[Demo], tmp_path: Path) -> None:
    """One episode shows another subtask, one has one frame."""
    rows = rows_of(demos[0], 1)
    other = {**rows, "phase": [0] * len(demos[0]), "episode_index": [0] * len(demos[0])}
    short = {key: values[:1] for key, values in rows_of(demos[1], 2).items()}
    path = write_dataset(tmp_path / "dataset", [other, rows, short])
    (made,) = import_dataset(path, task="place", out=tmp_path / "out")
    assert len(made.paths) == 1
    reasons = {row["bag"]: row["reason"] for row in made.skipped}
    assert reasons["episode 0"] == (
        "The recording shows no place; segmented by labels it shows grasp"
    )
    assert reasons["episode 2"].startswith("The topics overlap for 0.0 s")
    with pytest.raises(InputError, match="episode 0: insert: The recording shows no insert"):
        import_dataset(path, task="insert", out=tmp_path / "none")


def test_elements_are_found_by_name_or_order(demos: list[Demo], tmp_path: Path) -> None:
    """Datasets have short names, an ECM among the names, names in a table, or no names."""
    rows = rows_of(demos[0], 0)
    short = [
        name.replace("_pose.position.", "_pos_").replace("_pose.orientation.", "_quat_")
        for name in names.ABSOLUTE_STATE_NAMES
    ]
    swapped = {
        **rows,
        names.STATE: [[*row[8:], 9.0, *row[:8]] for row in rows[names.STATE]],
    }
    own = list(names.ABSOLUTE_STATE_NAMES)
    other = {**rows, names.STATE: [[*row[8:], *row[:8]] for row in rows[names.STATE]]}
    turned = [*own[8:], *own[:8]]
    placed = {name: turned.index(name) for name in own}
    sets = {
        "named": write_dataset(tmp_path / "named", [rows]),
        "short": write_dataset(tmp_path / "short", [rows], state_names=short),
        "unnamed": write_dataset(tmp_path / "unnamed", [rows], state_names=None),
        "ecm": write_dataset(
            tmp_path / "ecm", [swapped], state_names=[[*own[8:], "ecm_pose.position.x", *own[:8]]]
        ),
        "table": write_dataset(tmp_path / "table", [other], state_names={"motors": turned}),
        "places": write_dataset(tmp_path / "places", [other], state_names=placed),
    }
    states = []
    for name, path in sets.items():
        (made,) = import_dataset(path, task="place", out=tmp_path / f"{name}-out")
        states.append(read_demo(made.paths[0]).state)
    for state in states[1:]:
        np.testing.assert_array_equal(state, states[0])


def test_labels_come_from_phase_text_or_task(demos: list[Demo], tmp_path: Path) -> None:
    rows = rows_of(demos[0], 0)
    without = {key: values for key, values in rows.items() if key != "phase"}
    texts = write_dataset(tmp_path / "texts", [without])
    with pytest.raises(InputError, match="Needle Throw"):
        import_dataset(texts, task=None, out=tmp_path / "refused")
    meant = dataclasses.replace(BagConfig(), labels={"needle throw": "place"})
    (made,) = import_dataset(texts, task=None, out=tmp_path / "meant", config=meant)
    assert made.task == "place"
    bare = {key: values for key, values in without.items() if key != "instruction.text"}
    (made,) = import_dataset(
        write_dataset(tmp_path / "bare", [bare]), task=None, out=tmp_path / "of-task"
    )
    assert made.task == "place"


def test_a_frame_of_theirs_is_given_in_the_arm_s_base(demos: list[Demo], tmp_path: Path) -> None:
    """Poses in the arms' own bases give the same result if the config says so."""
    env = envs.make(demos[0].config)
    rows = rows_of(demos[0], 0)
    local = []
    for state in demos[0].state[:-1]:
        env.set_state_vector(state)
        row: list[float] = []
        for arm in names.ARMS:
            pose = poses.square(env.simulation.tip_in_base(arm))
            turn = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
            row += [*pose[:3, 3].tolist(), *turn, 2.0 * env.simulation.jaw(arm)]
        local.append(row)
    same = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    config = BagConfig(frames=Frames(psm1=same, psm2=same))
    found = []
    for name, state_rows, given in (
        ("view", rows[names.STATE], BagConfig()),
        ("base", local, config),
    ):
        path = write_dataset(tmp_path / name, [{**rows, names.STATE: state_rows}])
        (made,) = import_dataset(path, task="place", out=tmp_path / f"{name}-out", config=given)
        found.append(read_demo(made.paths[0]).state[:, 1 : 1 + env.model.nq])
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: {**rows, names.STATE: [[np.nan] * 16] * len(rows["phase"])}, "finite"),
        (lambda rows: {**rows, names.STATE: [[0.1] * 16] * len(rows["phase"])}, "unit quaternion"),
        (
            lambda rows: {**rows, names.STATE: [[0.1] * 3] * len(rows["phase"])},
            "fewer than are named",
        ),
    ],
)
def test_damaged_numbers_are_refused(
    demos: list[Demo], tmp_path: Path, spoil: Any, message: str
) -> None:
    path = write_dataset(tmp_path / "dataset", [spoil(rows_of(demos[0], 0))])
    with pytest.raises(BadFile, match=message):
        import_dataset(path, task="place", out=tmp_path / "out")


def other(key: str, value: object) -> Callable[[Rows], Rows]:
    """Return a function that puts one value into every frame of a column."""
    return lambda rows: {**rows, key: [value] * len(rows["timestamp"])}


def first(key: str, value: object) -> Callable[[Rows], Rows]:
    """Return a function that puts a value into a column's first frame."""
    return lambda rows: {**rows, key: [value, *rows[key][1:]]}


def test_too_many_frames_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_dataset(tmp_path / "dataset", [STILL])
    monkeypatch.setattr(lerobot_dataset, "MAX_FRAMES", len(STILL["timestamp"]) - 1)
    monkeypatch.setattr(lerobot_dataset.DatasetFiles, "_tasks", lambda _: {})
    monkeypatch.setattr(lerobot_dataset.pq, "read_table", None)
    with pytest.raises(BadFile, match="holds over"):
        import_dataset(path, task="place", out=tmp_path / "out")


def test_held_actions_are_refused(demos: list[Demo], tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "dataset", [rows_of(demos[0], 0)])
    with pytest.raises(InputError, match="action_repeat is 5"):
        import_dataset(path, task="place", out=tmp_path / "out", env={"action_repeat": 5})
    with pytest.raises(InputError, match="the task is a separate option"):
        import_dataset(path, task=None, out=tmp_path / "out", env={"task": "place"})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "spoil",
    [
        *(other("frame_index", value) for value in ("x", [1], None)),
        *(other("timestamp", value) for value in ("x", [1.0], None, 1e300)),
        *(other("episode_index", value) for value in ("x", [1], None, float("nan"), 0.5)),
        *(first(key, None) for key in ("phase", "frame_index", "timestamp", "episode_index")),
        lambda rows: {**rows, "frame_index": [list(range(i % 3)) for i in rows["frame_index"]]},
        other(names.STATE, 3),
    ],
)
def test_columns_of_other_types_are_bad_files(tmp_path: Path, spoil: Any) -> None:
    path = write_dataset(tmp_path / "dataset", [spoil(STILL)])
    with pytest.raises(BadFile):
        import_dataset(path, task="place", out=tmp_path / "out")


@pytest.mark.parametrize(
    ("file", "text"),
    [
        (names.INFO_FILE, lambda info: json.dumps({**info, "fps": 10**400})),
        (names.INFO_FILE, lambda info: json.dumps({**info, "total_frames": float("inf")})),
        (names.INFO_FILE, lambda info: json.dumps({**info, "features": []})),
        ("meta/tasks.jsonl", lambda _: '{"task_index": 1e400, "task": ""}'),
        ("meta/tasks.jsonl", lambda _: "[" * 100_000),
        ("meta/tasks.jsonl", lambda _: "3"),
    ],
)
def test_metadata_of_other_types_is_a_bad_file(tmp_path: Path, file: str, text: Any) -> None:
    path = write_dataset(tmp_path / "dataset", [STILL], "v2.1")
    info = json.loads((path / names.INFO_FILE).read_text())
    (path / file).write_text(text(info))
    with pytest.raises(BadFile):
        import_dataset(path, task="place", out=tmp_path / "out")


@pytest.mark.parametrize("phase", ["throwing", [1]])
def test_a_column_phase_of_somebody_elses_says_nothing(tmp_path: Path, phase: object) -> None:
    path = write_dataset(tmp_path / "dataset", [other("phase", phase)(STILL)])
    with pytest.raises(InputError, match="Needle Throw"):  # what `instruction.text` says
        import_dataset(path, task="place", out=tmp_path / "out")


def test_other_datasets_are_refused_and_the_command_says_so(
    demos: list[Demo], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = rows_of(demos[0], 0)
    own = write_dataset(tmp_path / "own", [rows], state_names=list("abcdefgh") * 2 + ["psm1_x"])
    assert main(["import-demos", str(own), "--out", str(tmp_path / "out")]) == 2
    assert "poses and jaws of both arms" in capsys.readouterr().err
    old = write_dataset(tmp_path / "old", [rows], "v1.6")
    assert main(["import-demos", str(old), "--out", str(tmp_path / "out")]) == 2
    assert "v1.6" in capsys.readouterr().err
    good = write_dataset(tmp_path / "good", [rows], "v2.1")
    assert main(["import-demos", str(good), "--topic", "needle=/n"]) == 2
    given = ["import-demos", str(good), "--task", "place", "--out", str(tmp_path / "out"), "--json"]
    assert main(given) == 0
    made = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert made["tasks"]["place"]["episodes"] == 1
