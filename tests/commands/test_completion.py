"""Shell completion: each script names every command, and bash completes with its script."""

import shutil
import subprocess

import pytest

from surgicai_vision.commands import COMMANDS, dataset
from surgicai_vision.commands.completion import SHELLS
from surgicai_vision.commands.main import main


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_names_every_command_and_its_options(shell, tmp_path, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for command in (*COMMANDS, *dataset.COMMANDS):
        assert command in script
    for word in ("accept-licence", "h264", "handoff", "wrist_psm1", "json", "config"):
        assert word in script, word
    if shutil.which(shell):
        path = tmp_path / "script"
        path.write_text(script)
        subprocess.run([shell, "-n", path], check=True)


def completed(script, *words):
    """Return what bash offers for the last of the words."""
    lines = f"""
        source {script}
        COMP_WORDS=({" ".join(repr(word) for word in words)})
        COMP_CWORD={len(words) - 1}
        $(complete -p surgicai-vision | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", lines], capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["tr"], ["train", "train-detector"]),
        (["re"], ["record-demos", "render-demos", "release", "report"]),
        (["dataset", ""], ["check", "convert", "push", "pull"]),
        (["dataset", "check", "--j"], ["--json"]),
        (["evaluate", "expert", "--task", "p"], ["place", "pullout"]),
        (["render-demos", "--no-d"], ["--no-depth"]),
    ],
)
def test_bash_completes(words, offered, tmp_path, capsys):
    main(["completion", "bash"])
    script = tmp_path / "surgicai-vision.bash"
    script.write_text(capsys.readouterr().out)
    assert completed(script, "surgicai-vision", *words) == offered
