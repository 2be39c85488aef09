"""The command line: help, one-line errors for wrong input, options from files, exit codes."""

import dataclasses
import io
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import yaml
from cyclopts import Parameter
from read_options import read_options

from surgicai_vision.commands import COMMANDS, dataset, evaluate, policy, quickstart, robot
from surgicai_vision.commands.console import Console, QuietConsole
from surgicai_vision.commands.main import INTERRUPTED, main
from surgicai_vision.commands.options import COUNT, FILE_ONLY, VIEWS
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.core.files import configs_folder

GROUPS = {"dataset": dataset, "policy": policy, "robot": robot}
ALL_COMMANDS = (
    *(name for name in COMMANDS if name not in GROUPS),
    *(f"{group} {name}" for group, package in GROUPS.items() for name in package.COMMANDS),
)
HEAVY = {"torch", "lerobot", "mujoco", "scipy", "cv2", "pandas", "matplotlib", "transformers"}
PROGRAM = Path(sys.executable).with_name("surgicai-vision")


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Run in an empty folder: default outputs must not land in the checkout."""
    monkeypatch.chdir(tmp_path)


def fails(capsys, *arguments):
    """Run a command that must exit with 2, one line and no traceback; return the line."""
    code = main(list(arguments))
    captured = capsys.readouterr()
    assert code == 2, captured.err
    assert "Traceback" not in captured.err
    lines = [line for line in captured.err.splitlines() if line]
    assert len(lines) == 1, captured.err
    assert captured.out == ""
    return lines[0]


@pytest.mark.parametrize("command", ALL_COMMANDS)
def test_help_shows_options_and_an_example(command, capsys):
    assert main([*command.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert f"example:\n  surgicai-vision {command}" in text
    assert "--json" in text
    assert "--config" in text


def test_help_of_an_option_breaks_only_where_the_window_ends():
    code = (
        "from surgicai_vision.commands.main import main\n"
        f"for name in {ALL_COMMANDS}:\n"
        "    main([*name.split(), '--help'])"
    )
    wide = {**os.environ, "COLUMNS": "2000"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=wide
    )
    rows = [line.strip("│* ") for line in done.stdout.splitlines() if line.startswith("│")]
    assert len(rows) > len(ALL_COMMANDS)
    for row in rows:
        assert row.startswith("--") or " --" in row.split("  ")[0]


def test_help_names_every_command_in_the_order_of_the_flow(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    places = [text.index(f"│ {command} ") for command in COMMANDS]
    assert places == sorted(places)


def test_help_of_a_group_names_its_commands(capsys):
    for group, package in GROUPS.items():
        assert main([group]) == 2
        capsys.readouterr()
        assert main([group, "--help"]) == 0
        text = capsys.readouterr().out
        assert f"Usage: surgicai-vision {group} COMMAND" in text
        assert all(f"│ {command} " in text for command in package.COMMANDS)


def test_help_imports_nothing_heavy():
    code = (
        "import sys, contextlib, io\n"
        "from surgicai_vision.commands.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n"
        f"    codes = [main([*name.split(), '--help']) for name in {ALL_COMMANDS}]\n"
        f"print(codes, sorted({HEAVY} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"{[0] * len(ALL_COMMANDS)} []"


def test_help_of_all_imports_no_command():
    code = (
        "import sys, contextlib, io\n"
        "from surgicai_vision.commands.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n"
        "    main(['--help'])\n"
        "package = 'surgicai_vision.commands.'\n"
        "print(sorted(name for name in sys.modules if name.startswith(package)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    helpers = ("main", "options", "os_errors")
    assert done.stdout.strip() == str([f"surgicai_vision.commands.{name}" for name in helpers])


def test_no_arguments_show_help_and_fail(capsys):
    assert main([]) == 2
    assert "Commands" in capsys.readouterr().out


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("surgicai-vision 0.")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["evaluat"], "Did you mean 'evaluate'?"),
        (["dataset", "chek"], "Unknown command of dataset 'chek'. Did you mean 'check'?"),
        (["dataset", "--jsn"], "Did you mean '--json'?"),
        (["dataset", "check"], "DIR is missing; see `surgicai-vision dataset check --help`"),
        (["dataset", "check", "missing"], "missing is not a dataset"),
        (["dataset", "check", "missing", "--jsn"], "Did you mean '--json'?"),
        (["--vresion"], "Did you mean '--version'?"),
        (["evaluate", "expert", "--episods", "5"], "Did you mean '--episodes'?"),
        (["evaluate", "--episods=5"], "Did you mean '--episodes'?"),
        (["evaluate", "expert", "--episode", "5"], "Did you mean '--episodes'?"),
        (["evaluate"], "POLICY is missing"),
        (["submit", "outputs"], "error: --name is missing"),
        (["evaluate", "expert", "expert"], "unexpected argument"),
        (
            ["evaluate", "expert", "--episodes", "-5"],
            "Invalid value '-5' for --episodes. Must be >= 1",
        ),
        (["evaluate", "expert", "--episodes", "0"], "'0' for --episodes. Must be >= 1"),
        (["evaluate", "expert", "--episodes", "many"], "expected a whole number, got 'many'"),
        (["evaluate", "expert", "--seed", "-1"], "Invalid value '-1' for --seed. Must be >= 0"),
        (["evaluate", "expert", "--episodes", "3.5"], "expected a whole number, got '3.5'"),
        (["evaluate", "expert", "--episodes"], "--episodes needs a value"),
        (["evaluate", "expert", "--task", "grsp"], "Did you mean 'grasp'?"),
        (["evaluate", "expert", "--task", "grsp"], "Choose from: 'grasp', 'place'"),
        (["evaluate", "expert", "--task", "grasp", "--task", "place"], "--task specified multiple"),
        (["evaluate", "expert", "--env", "3"], "belongs in a --config file"),
        (["evaluate", "expert", "--config"], "--config needs a value"),
        (["completion", "bsh"], "Did you mean 'bash'?"),
        (["robustness", "expert", "--strength", "0,much"], "unable to convert 'much' into float"),
        (["evaluate", "exprt"], "Did you mean 'expert'?"),
        (["evaluate", "no/such/folder"], "no/such/folder"),
        (["render-demos", "--view", "front,bakc"], "Did you mean 'back'?"),
        (["render-demos", "--view", "front,front"], "twice"),
        (["render-demos", "--view", "front,,back"], "separate the names by commas"),
        (["render-demos", "--view", ""], "--view is empty"),
        (["render-demos", "--demos", "missing"], "missing"),
        (["render-demos", "--demos", "missing", "--episodes", "3"], "nothing is recorded"),
        (["render-demos", "--demos", "missing", "--seed", "3"], "nothing is recorded"),
        (["render-demos", "--distractors", "0"], "'0' for --distractors. Must be >= 1"),
        (["record-demos", "--episodes", "-3"], "'-3' for --episodes. Must be >= 1"),
        (["record-demos", "--noise", "-0.1"], "Invalid value '-0.1' for --noise. Must be >= 0"),
        (["record-demos", "--executor", "rai"], "Did you mean 'ray'?"),
        (["render-demos", "--executor", "local,address=10.0.0.1:6379"], "local takes no options"),
        (
            ["record-demos", "--perturb-start-fraction", "2"],
            "Invalid value '2.0' for --perturb-start-fraction. Must be <= 1",
        ),
        (["train", "--encoder", "rndom"], "Did you mean 'random'?"),
        (["train", "--encoder", "none", "--view", "back"], "leave --view out"),
        (
            ["train", "--encoder", "random", "--view", "back"],
            "surgicai-vision render-demos --task grasp",
        ),
        (["train", "--encoder", "random", "--dataset", "missing"], "missing"),
        (["encode", "--encoder", "random", "--dataset", "missing"], "missing"),
        (["import-demos", "missing.pkl", "--task", "handoff"], "missing.pkl"),
        (["import-demos", "missing.pkl"], "--task"),
        (["report", "missing"], "missing"),
        (["report", "."], "holds no evaluation"),
        (["sweep", "missing.yaml"], "missing.yaml"),
        (["sweep", "smok"], "Did you mean 'smoke'?"),
        (["scene", "--sheet", "sheet.bmp"], "'.bmp'"),
        (["quickstart", "--config", "missing.yaml"], "missing.yaml"),
        (["quickstart", "--size", "2000"], "'2000' for --size. Must be <= 960"),
        (["train", "--seed", str(2**63)], f"for --seed. Must be <= {2**63 - 1}"),
        (["train", "--algo", "td3", "--seed", str(2**32)], "at most"),
        (["evaluate", "zero", "--out", "x" * 300], "File name too long"),
        (["sweep", "smoke", "--out", "x" * 300], "File name too long"),
        (["leaderboard", ".", "--out", "x" * 300 + ".html"], "File name too long"),
        (["leaderboard", ".", "--out", "/proc/page.html"], "cannot be written"),
        (["leaderboard", ".", "--out", "page.txt"], "allowed: .html"),
        (["report", ".", "--out", "/proc/page.html"], "cannot be written"),
        (["submit", ".", "--name", "a", "--by", "b", "--out", "/proc/row.json"], "--out"),
    ],
)
def test_wrong_input_is_one_line(arguments, said, capsys):
    assert said in fails(capsys, *arguments)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("env: {max_stpes: 4}", "Did you mean 'max_steps'?"),
        ("env: {scene: {thread: 7}}", "thread is 7"),
        ("env: {task: place}", "separate option"),
        ("env: 4", "env"),
    ],
)
def test_a_wrong_env_table_is_one_line(text, said, tmp_path, capsys):
    write(tmp_path / "env.yaml", text)
    assert said in fails(capsys, "evaluate", "zero", "--config", "env.yaml")


def test_missing_weights_are_said_before_anything_else(capsys):
    line = fails(capsys, "train", "--encoder", "r3m", "--view", "back")
    for part in ("pytorch_model.bin", "sha256", "--weights FILE", "imagenet-lite", "random"):
        assert part in line


@pytest.mark.parametrize(
    "arguments",
    [
        ["evaluate", "zero", "--out", "full"],
        ["record-demos", "--out", "full"],
        ["render-demos", "--out", "full"],
        ["quickstart", "--out", "full"],
        ["sweep", "smoke", "--out", "full"],
    ],
)
def test_a_full_output_folder_is_refused(arguments, tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    assert "already holds files" in fails(capsys, *arguments)
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("place", ["/proc/nothing", "file/below"])
@pytest.mark.parametrize(
    "arguments", [["evaluate", "zero"], ["record-demos"], ["quickstart"], ["sweep", "smoke"]]
)
def test_an_output_folder_that_cannot_be_made_is_refused(arguments, place, tmp_path, capsys):
    (tmp_path / "file").write_text("a file, no folder")
    assert "--out" in fails(capsys, *arguments, "--out", place)


@pytest.mark.parametrize("place", [".", "link", "dangling"])
@pytest.mark.parametrize("command", ["record-demos", "render-demos"])
def test_a_folder_that_nothing_can_be_renamed_to_is_refused(command, place, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to("empty")
    (tmp_path / "dangling").symlink_to("nowhere")
    os.chdir("empty" if place == "." else tmp_path)
    line = fails(capsys, command, "--episodes", "1", "--workers", "1", "--out", place)
    assert "cannot be replaced" in line
    left = sorted(path.name for path in tmp_path.rglob("*"))
    assert left == ["dangling", "empty", "link"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("evaluate zero --video-of failures", "--video-of goes with --video"),
        ("evaluate zero --video-size 64", "--video-size goes with --video"),
        ("scene --film a.png --looks b.png", "--film and --looks are given"),
        ("saliency zero --step 1.5", "expected a whole number, got '1.5'"),
        ("policy tune h.yaml --patience 1.5,2.4", "expected a whole number, got '1.5'"),
        ("robot serve --seconds inf", "1000000"),
        ("cache prune --keep nope", "There is no dataset nope"),
    ],
)
def test_what_would_be_ignored_or_rounded_is_refused(words, said, capsys):
    assert said in fails(capsys, *words.split())


def test_an_unwritable_sheet_is_refused(capsys):
    assert "cannot be written" in fails(capsys, "scene", "--sheet", "/proc/sheet.png")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Sample:
    """Options of a command that does not exist."""

    episodes: Annotated[int, COUNT] = 5
    view: Annotated[tuple[str, ...], VIEWS] = ("back",)
    folder: Path | None = None
    noise: float = 0.0
    depth: bool = False
    scene: Annotated[SceneConfig | None, FILE_ONLY] = None


def write(path, text):
    path.write_text(text)
    return path


def test_the_command_line_overrides_the_file(tmp_path):
    text = (
        "episodes: 7\nview: front,back\nfolder: a/b\nnoise: 1\ndepth: true\nscene: {thread: 20}\n"
    )
    path = write(tmp_path / "a.yaml", text)
    from_file = Sample(
        episodes=7,
        view=("front", "back"),
        folder=Path("a/b"),
        noise=1.0,
        depth=True,
        scene=SceneConfig(thread=20),
    )
    assert read_options(Sample, config=path) == from_file
    words = ["--episodes", "9", "--no-depth", "--view", "back"]
    overridden = dataclasses.replace(from_file, episodes=9, depth=False, view=("back",))
    assert read_options(Sample, words, path) == overridden


def test_comma_lists_and_repetition_give_the_same(tmp_path):
    for words in (
        ["--view", "front,back"],
        ["--view", "front", "--view", "back"],
        ["--view=front, back"],
    ):
        assert read_options(Sample, words).view == ("front", "back")
    path = write(tmp_path / "a.yaml", "view: [front, back]\nfolder: null")
    assert read_options(Sample, config=path) == Sample(view=("front", "back"))


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("episods: 3", UnknownName, "Did you mean 'episodes'"),
        ("scene: {tread: 3}", UnknownName, "Did you mean 'thread'"),
        ("episodes: many", InputError, "expected int"),
        ("episodes: 3.5", InputError, "expected int"),
        ("episodes: -1", InputError, "Must be >= 1"),
        ("depth: 1", InputError, "expected bool"),
        ("folder: [a]", InputError, "expected str"),
        ('folder: "a\\0b"', InputError, "a character that no name can contain"),
        ('folder: "\\ud800"', InputError, "a character that no name can contain"),
        (f"noise: {'9' * 400}", InputError, "is too large"),
        ("view: [bakc]", InputError, "Did you mean 'back'"),
        ("view: back,back", InputError, "twice"),
        ("view: {back: 1}", InputError, "expected a list"),
        ("- 1", BadFile, "not a table"),
        ("a: [", BadFile, "not valid YAML"),
        ("!!python/object/apply:os.system ['true']", BadFile, "not valid YAML"),
    ],
)
def test_a_wrong_file_is_refused(text, error, said, tmp_path):
    with pytest.raises(error, match=said):
        read_options(Sample, config=write(tmp_path / "a.yaml", text))


def test_a_file_is_read_whole_even_where_the_command_line_overrides_it(tmp_path):
    with pytest.raises(InputError, match="expected int"):
        read_options(Sample, ["--episodes", "3"], write(tmp_path / "a.yaml", "episodes: many"))


def test_shipped_quickstart_is_the_default():
    shipped = read_options(quickstart.Options, config=configs_folder() / "quickstart.yaml")
    default = quickstart.Options()
    assert quickstart.plan_of(shipped) == quickstart.plan_of(default)


def test_null_in_a_file_is_none_whatever_the_default(tmp_path):
    path = write(tmp_path / "a.yaml", "procedure: null")
    assert quickstart.plan_of(read_options(quickstart.Options, config=path)).procedure is None
    assert read_options(quickstart.Options, ["--procedure", "expert"], path).procedure == "expert"


@pytest.mark.parametrize(
    "path", sorted((configs_folder() / "sweep").glob("*.yaml")), ids=lambda path: path.stem
)
def test_shipped_sweeps_list_their_cells(path, capsys):
    assert main(["sweep", str(path), "--dry-run", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["runs"] > 0


def test_a_wrong_grid_is_refused(tmp_path, capsys):
    grid = {"task": ["grasp"], "encoder": ["imagnet-lite"], "view": [["back"]]}
    path = write(tmp_path / "grid.yaml", yaml.safe_dump(grid))
    assert "Did you mean 'imagenet-lite'" in fails(capsys, "sweep", str(path))
    path.write_text(yaml.safe_dump({**grid, "encodr": []}))
    assert "Did you mean 'encoder'" in fails(capsys, "sweep", str(path))


def test_cells_without_weights_are_listed_as_not_run(tmp_path, capsys):
    path = write(
        tmp_path / "grid.yaml",
        "task: [grasp]\nencoder: [r3m, random]\nview: [back, 'front,back']\n",
    )
    assert main(["sweep", str(path), "--dry-run", "--json"]) == 0
    out = capsys.readouterr().out
    result = json.loads(out.splitlines()[-1])
    assert (result["runs"], result["not_run"], result["to_do"]) == (4, 2, 2)
    (line,) = (line for line in out.splitlines() if "pytorch_model.bin" in line)
    assert line.startswith("not run, 2 runs: Encoder 'r3m' needs"), "a reason is told once"


def test_interruption_says_how_to_continue(monkeypatch, capsys):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "open_given", interrupted)
    assert main(["evaluate", "zero"]) == 1
    assert INTERRUPTED in capsys.readouterr().err


def test_interruption_while_the_program_starts_is_one_line():
    code = (
        "import signal, sys\n"
        "from surgicai_vision.__main__ import main\n"
        "class Interrupted:\n"
        "    def find_spec(name, path, target=None):\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "sys.meta_path.insert(0, Interrupted)\n"
        "main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, f"surgicai-vision: {INTERRUPTED}\n")


def test_output_holds_what_its_encoding_can(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, "latin-1", write_through=True))
    assert main(["--help"]) == 0
    assert b"scene ? env ? demos" in written.getvalue()


def test_evaluate_prints_one_json_object_last(capsys, tmp_path):
    write(tmp_path / "short.yaml", "env: {max_steps: 4}\nepisodes: 2\nworkers: 1\n")
    assert main(["evaluate", "zero", "--config", "short.yaml", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["policy"], result["episodes"], result["successes"], result["errors"]) == (
        "zero",
        2,
        0,
        0,
    )
    assert result["ci95"][0] == 0.0
    assert sorted(os.listdir(result["out"])) == [
        "episodes.parquet",
        "evaluation.json",
        "films.safetensors",
    ]
    assert main(["evaluate", "zero", "--config", "short.yaml"]) == 0, (
        "a second run replaces the first"
    )


def test_quiet_console_shows_nothing(capsys):
    console = QuietConsole()
    console.say("x")
    with console.stage("a") as progress:
        progress(1, 2)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("title", ["short", "policy: " + "a-setting=0.98 [of] " * 8])
def test_a_narrow_line_of_progress_cuts_the_title_and_no_number(title, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with Console().stage(title, "control steps") as progress:
        progress(7500, 7500)
    line = capsys.readouterr().err
    assert "7500/7500 control steps 00:00" in line
    assert line.startswith(title[:20])
    assert ("…" in line) == (title != "short")


def test_scene_draws_the_sheet(capsys, tmp_path):
    arguments = [
        "scene",
        "--view",
        "front,back",
        "--size",
        "64",
        "--quality",
        "fast",
        "--sheet",
        "a/sheet.png",
    ]
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["views"] == ["front", "back"]
    assert result["success"] is True
    assert (tmp_path / "a" / "sheet.png").read_bytes().startswith(b"\x89PNG")


def test_scene_draws_looks(capsys, tmp_path):
    arguments = ["scene", "--looks", "looks.png", "--view", "front", "--size", "32", "--draws", "1"]
    assert main([*arguments, "--appearance", "train,plain", "--quality", "fast", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["looks"] == [*names.TRAIN_APPEARANCES, "plain"]
    assert (tmp_path / "looks.png").read_bytes().startswith(b"\x89PNG")
    assert "'mucos'" in fails(capsys, *arguments, "--appearance", "mucos")
    assert "6" in fails(capsys, *arguments, "--distractors", "6")


@pytest.mark.parametrize("kind", ["needles", "placements"])
def test_scene_draws_a_world_that_varies(kind, capsys, tmp_path):
    path = tmp_path / f"{kind}.png"
    options = ["--view", "front", "--size", "32", "--quality", "fast"]
    assert main(["scene", f"--{kind}", str(path), *options, "--json"]) == 0
    assert path.read_bytes().startswith(b"\x89PNG")
