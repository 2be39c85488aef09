"""Wrong bags and options: one line names what is available, and no code in a bag is run."""

import json
import sys

import pytest
import yaml
from bag_writer import TOPICS, shown, streams, write_bag

from surgicai_vision.commands.main import main
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.demos.imports.rosbag import reader
from surgicai_vision.demos.imports.rosbag.config import BagConfig, Topics
from surgicai_vision.demos.imports.rosbag.importer import import_bags
from surgicai_vision.demos.store import read_marker


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """A bag of a grasp, without labels."""
    return write_bag(
        tmp_path_factory.mktemp("bags") / "trial", "bag", streams(shown("grasp"), labels=False)
    )


def test_topics_that_are_not_there_are_refused_with_those_that_are(trial, tmp_path):
    for config, message in (
        (
            BagConfig(topics=Topics(needle="/needle")),
            r"no topic /needle \(needle\); it has /needle/measured_cp \(geom",
        ),
        (
            BagConfig("ambf"),
            r"none of /CRTK/psm1/measured_cp, .*The topics are /PSM1/measured_cp \(geom",
        ),
        (
            BagConfig(topics=Topics(needle="/PSM1/jaw/measured_js")),
            "holds sensor_msgs/JointState; types allowed for needle:",
        ),
        (
            BagConfig(topics=Topics(psm2_pose="/PSM2/jaw/measured_js")),
            "types allowed for psm2_pose: geometry_msgs/PoseSt",
        ),
    ):
        with pytest.raises(InputError, match=message) as caught:
            import_bags([trial], task="grasp", out=tmp_path / "demos", config=config)
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "demos").exists()


def test_a_task_that_is_not_shown_is_refused(trial, tmp_path):
    with pytest.raises(InputError, match="shows no insert; segmented by events it shows grasp"):
        import_bags([trial], task="insert", out=tmp_path / "demos")
    with pytest.raises(UnknownName, match="Did you mean 'insert'"):
        import_bags([trial], task="insrt", out=tmp_path / "demos")


def test_an_arm_that_is_not_recorded_is_named(tmp_path):
    found = {
        role: rows for role, rows in streams(shown("grasp")).items() if not role.startswith("psm2")
    }
    bag = write_bag(tmp_path / "trial", "mcap", found)
    with pytest.raises(
        InputError,
        match=r"grasp is done by psm2, whose pose is not on /PSM2/measured_cp\. The topics",
    ):
        import_bags([bag], task="grasp", out=tmp_path / "demos")
    found = {role: rows for role, rows in streams(shown("grasp")).items() if role != "psm2_jaw"}
    bag = write_bag(tmp_path / "jawless", "mcap", found)
    with pytest.raises(
        InputError, match="grasp needs the jaw of psm2, which is not on /PSM2/jaw/measured_js"
    ):
        import_bags([bag], task="grasp", out=tmp_path / "demos")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"topics": {"neddle": "/x"}}, "Did you mean 'needle'"),
        ({"topics": {"needle": "x"}}, "begins with '/'"),
        ({"convention": "dvkr"}, "Did you mean 'dvrk'"),
        ({"frames": {"psm1": [1, 2, 3]}}, "seven numbers"),
        ({"labels": {"a": "graps"}}, "Did you mean 'grasp'"),
        ({"speed": 0.0}, "above 0"),
        ({"step": "papr"}, "Did you mean 'paper'"),
        ({"segmentation": "label"}, "Did you mean 'labels'"),
    ],
)
def test_a_wrong_table_is_one_line(trial, tmp_path, capsys, table, message):
    (tmp_path / "bag.yaml").write_text(yaml.safe_dump({"bag": table}))
    assert (
        main(
            [
                "import-demos",
                str(trial),
                "--config",
                str(tmp_path / "bag.yaml"),
                "--out",
                str(tmp_path / "o"),
            ]
        )
        == 2
    )
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]


def test_the_command_line_reads_a_folder_of_bags(tmp_path, capsys):
    for seed in (0, 3):
        write_bag(
            tmp_path / f"bags/trial{seed}",
            "mcap",
            streams(shown("grasp", seed)),
            {**TOPICS, "needle": "/n"},
        )
    (tmp_path / "bag.yaml").write_text(
        "bag: {drop_pauses: false, topics: {label: /subtask}}\nenv: {scene: {thread: 0}}"
    )
    command = [
        "import-demos",
        str(tmp_path / "bags"),
        "--out",
        str(tmp_path / "demos"),
        "--topic",
        "needle=/n",
        "--json",
    ]
    assert main([*command, "--config", str(tmp_path / "bag.yaml")]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["bags"] == 2
    assert result["tasks"]["grasp"]["episodes"] == 2
    assert result["tasks"]["grasp"]["pauses"] == 0
    assert read_marker(tmp_path / "demos/grasp")["demonstrator"] == "bag"


def test_options_of_bags_are_refused_for_pickles(tmp_path, capsys):
    (tmp_path / "x.pkl").write_bytes(b"")
    assert (
        main(["import-demos", str(tmp_path / "x.pkl"), "--task", "grasp", "--topic", "needle=/n"])
        == 2
    )
    assert "--topic is for bags" in capsys.readouterr().err
    assert main(["import-demos", str(tmp_path), "--task", "grasp"]) == 2
    assert "a folder without bags" in capsys.readouterr().err


def test_no_definition_of_a_bag_becomes_code(trial):
    """`rosbags` would turn a bag's definitions into a module; we never let it."""
    sys.modules.pop("rosbags.usertypes", None)
    reader.read(trial, BagConfig().all_topics)
    assert "rosbags.usertypes" not in sys.modules


def test_missing_and_packed_bags_are_told(tmp_path):
    with pytest.raises(BadFile, match="no such file"):
        import_bags([tmp_path / "nothing.bag"], task="grasp", out=tmp_path / "demos")
    bag = write_bag(tmp_path / "trial", "db3", streams(shown("grasp")))
    table = yaml.safe_load((bag / "metadata.yaml").read_text())
    table["rosbag2_bagfile_information"] |= {
        "compression_mode": "FILE",
        "compression_format": "zstd",
    }
    (bag / "metadata.yaml").write_text(yaml.safe_dump(table))
    with pytest.raises(BadFile, match="decompress it first"):
        import_bags([bag], task="grasp", out=tmp_path / "demos")
