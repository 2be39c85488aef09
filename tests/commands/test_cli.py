"""The command line: help, wrong input in one line, options from files, exit codes."""

import importlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass

import pytest
import yaml

from surgicai_vision.commands import VERBS, evaluate, module_name, quickstart
from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.commands.main import INTERRUPTED, main
from surgicai_vision.commands.options import build, config_only, many_of, option, positive
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.core.files import configs_folder


def all_verbs():
    """Every verb, those inside a verb with both words."""
    for verb in VERBS:
        inner = getattr(importlib.import_module(module_name(verb)), "VERBS", None)
        yield from [verb] if inner is None else [f"{verb} {name}" for name in inner]


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Run in an empty folder: default outputs must not land in the checkout."""
    monkeypatch.chdir(tmp_path)


def fails(capsys, *arguments):
    """Run a command that must end with 2, one line and no traceback; return the line."""
    code = main(list(arguments))
    captured = capsys.readouterr()
    assert code == 2, captured.err
    assert "Traceback" not in captured.err
    lines = [line for line in captured.err.splitlines() if line]
    assert len(lines) == 1, captured.err
    assert captured.out == ""
    return lines[0]


@pytest.mark.parametrize("verb", list(all_verbs()))
def test_help_shows_options_and_an_example(verb, capsys):
    assert main([*verb.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert f"example:\n  surgicai-vision {verb}" in text
    assert "--json" in text
    assert "--config" in text


def test_help_names_every_verb(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(verb in text for verb in VERBS)


def test_help_of_a_verb_with_verbs_names_them(capsys):
    assert main(["dataset"]) == 2
    assert main(["dataset", "--help"]) == 0
    text = capsys.readouterr().out
    assert "usage: surgicai-vision dataset VERB" in text
    assert "check" in text
    assert "repair" in text


def test_help_imports_nothing_heavy():
    verbs = list(all_verbs())
    code = (
        "import sys, contextlib, io\n"
        "from surgicai_vision.commands.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n"
        f"    codes = [main([*verb.split(), '--help']) for verb in {verbs}]\n"
        "print(codes, sorted({'torch', 'lerobot', 'mujoco', 'scipy', 'cv2', 'pandas'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"{[0] * len(verbs)} []"


def test_no_arguments_show_help_and_fail(capsys):
    assert main([]) == 2
    assert "verbs:" in capsys.readouterr().out


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("surgicai-vision 0.")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["evaluat"], "Did you mean 'evaluate'?"),
        (["dataset", "chek"], "Unknown verb of dataset 'chek'. Did you mean 'check'?"),
        (["dataset", "--jsn"], "option before the verb"),
        (["dataset", "check"], "dataset check: the following arguments are required: DIR"),
        (["dataset", "check", "missing"], "missing is not a dataset"),
        (["dataset", "check", "missing", "--jsn"], "Did you mean '--json'?"),
        (["dataset", "repair", "missing"], "missing is no LeRobot dataset"),
        (["--vresion"], "Did you mean '--version'?"),
        (["evaluate", "expert", "--episods", "5"], "Did you mean '--episodes'?"),
        (["evaluate", "--episods=5"], "Did you mean '--episodes'?"),
        (["evaluate", "expert", "--episode", "5"], "Did you mean '--episodes'?"),
        (["evaluate"], "POLICY"),
        (["evaluate", "expert", "expert"], "unexpected argument"),
        (["evaluate", "expert", "--episodes", "-5"], "--episodes is -5; it must be at least 1"),
        (["evaluate", "expert", "--episodes", "0"], "--episodes is 0"),
        (["evaluate", "expert", "--episodes", "many"], "expected a whole number, got 'many'"),
        (["evaluate", "expert", "--seed", "-1"], "--seed is -1; it must be at least 0"),
        (["evaluate", "expert", "--task", "grsp"], "Did you mean 'grasp'?"),
        (["evaluate", "exprt"], "Did you mean 'expert'?"),
        (["evaluate", "no/such/folder"], "no/such/folder"),
        (["render-demos", "--view", "front,bakc"], "Did you mean 'back'?"),
        (["render-demos", "--view", "front,front"], "twice"),
        (["render-demos", "--view", "front,,back"], "names between commas"),
        (["render-demos", "--view", ""], "--view is empty"),
        (["render-demos", "--demos", "missing"], "missing"),
        (["render-demos", "--demos", "missing", "--episodes", "3"], "nothing is recorded"),
        (["record-demos", "--episodes", "-3"], "--episodes is -3"),
        (["record-demos", "--noise", "-0.1"], "--noise is -0.1; it must be within 0 and 1"),
        (["record-demos", "--executor", "rai"], "Did you mean 'ray'?"),
        (["record-demos", "--perturb-start-fraction", "2"], "--perturb-start-fraction is 2.0"),
        (["render-demos", "--executor", "local,address=10.0.0.1:6379"], "local takes no options"),
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
    ],
)
def test_wrong_input_is_one_line(arguments, said, capsys):
    assert said in fails(capsys, *arguments)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("env: {max_stpes: 4}", "Did you mean 'max_steps'?"),
        ("env: {scene: {thread: 7}}", "thread is 7"),
        ("env: {task: place}", "option of its own"),
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


def test_an_unwritable_sheet_is_refused(capsys):
    assert "cannot be written" in fails(capsys, "scene", "--sheet", "/proc/sheet.png")


@dataclass(frozen=True)
class Sample:
    """Options of a verb that does not exist."""

    episodes: int = option(5, "episodes", check=positive)
    view: tuple[str, ...] = option(("back",), "views", check=many_of("view", names.CAMERAS))
    scene: SceneConfig | None = config_only()


def write(path, text):
    path.write_text(text)
    return path


def test_the_command_line_overrides_the_file(tmp_path):
    path = write(tmp_path / "a.yaml", "episodes: 7\nview: front,back\nscene: {thread: 20}\n")
    assert build(Sample, {}, path) == Sample(7, ("front", "back"), SceneConfig(thread=20))
    assert build(Sample, {"episodes": 9}, path).episodes == 9


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("episods: 3", UnknownName, "Did you mean 'episodes'"),
        ("scene: {tread: 3}", UnknownName, "Did you mean 'thread'"),
        ("episodes: many", InputError, "expected int"),
        ("episodes: -1", InputError, "at least 1"),
        ("view: [bakc]", UnknownName, "Did you mean 'back'"),
        ("- 1", BadFile, "no table"),
        ("a: [", BadFile, "not valid YAML"),
        ("!!python/object/apply:os.system ['true']", BadFile, "not valid YAML"),
    ],
)
def test_a_wrong_file_is_refused(text, error, said, tmp_path):
    with pytest.raises(error, match=said):
        build(Sample, {}, write(tmp_path / "a.yaml", text))


def test_shipped_quickstart_is_the_default():
    shipped = build(quickstart.Options, {}, configs_folder() / "quickstart.yaml")
    default = quickstart.Options()
    assert quickstart.plan_of(shipped) == quickstart.plan_of(default)


@pytest.mark.parametrize(
    "path", sorted((configs_folder() / "sweep").glob("*.yaml")), ids=lambda path: path.stem
)
def test_shipped_sweeps_list_their_cells(path, capsys):
    assert main(["sweep", str(path), "--dry-run", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["cells"] > 0


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
    assert (result["cells"], result["not_run"], result["to_do"]) == (4, 2, 2)
    assert "pytorch_model.bin" in out


def test_interruption_says_how_to_continue(monkeypatch, capsys):
    def interrupted(options, console):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "run", interrupted)
    assert main(["evaluate", "zero"]) == 1
    assert INTERRUPTED in capsys.readouterr().err


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


def test_every_verb_has_its_module():
    for verb in all_verbs():
        module = importlib.import_module(module_name(verb))
        assert module.EXAMPLE.startswith(f"surgicai-vision {verb}")
        assert callable(module.run)


def test_quiet_console_shows_nothing(capsys):
    console = QuietConsole()
    console.say("x")
    with console.stage("a") as progress:
        progress(1, 2)
    assert capsys.readouterr() == ("", "")


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
