"""Documentation: the verbs, options, files and modules it names exist; its tables are intact."""

import contextlib
import functools
import importlib.util
import io
import itertools
import re
import shlex
from pathlib import Path

import pytest

from surgicai_vision.commands import COMMANDS
from surgicai_vision.commands.main import main
from surgicai_vision.core.plugins import (
    CAMERAS_GROUP,
    ENCODERS_GROUP,
    ENGINES_GROUP,
    POLICIES_GROUP,
    TASKS_GROUP,
)

PROGRAM = "surgicai-vision"
ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs/recipes").glob("*.md")),
    *sorted((ROOT / "docs/results").rglob("*.md")),
]
COMMAND = re.compile(rf"^(?:\s{{4,}}|\| `|`){PROGRAM} ([a-z][^`|#\n]*)", re.MULTILINE)
FILE = re.compile(
    r"`((?:docs|benchmarks|configs|examples|data|encoders|policies|scripts|surgicai_vision|tests)/"
    r"[\w./-]+)`"
)
GROUPS = {ENCODERS_GROUP, POLICIES_GROUP, TASKS_GROUP, CAMERAS_GROUP, ENGINES_GROUP}
RULE = re.compile(r"\|(:?-{3,}:?\|)+")
"""The line between a table's head and its rows."""
MODULE = re.compile(r"\b(surgicai_vision(?:\.[a-z_]+)+)\b")


@functools.cache
def help_of(verb: str) -> str:
    """What `VERB --help` prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main([*verb.split(), "--help"]) == 0
    return printed.getvalue()


def commands(page: Path) -> list[list[str]]:
    """The words of each of our command lines in a page, with continued lines joined."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    return [shlex.split(found) for found in COMMAND.findall(text)]


def name_of(page: Path) -> str:
    """A page's path in the repository."""
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_in_docs_have_verbs_and_options_that_exist(page: Path) -> None:
    for words in commands(page):
        if words[0].startswith("-") or words[0].isupper():
            continue
        assert words[0] in COMMANDS, f"{page.name}: {PROGRAM} {shlex.join(words)}"
        shown = help_of(words[0])
        if len(words) > 1 and f"{words[0]} {words[1]}" in _grouped(words[0]):
            shown = help_of(f"{words[0]} {words[1]}")
        for word in words[1:]:
            if word.startswith("--"):
                name = word.split("=")[0]
                assert re.search(rf"{re.escape(name)}\b", shown), (
                    f"{page.name}: {PROGRAM} {shlex.join(words)}: {name}"
                )


def _grouped(verb: str) -> set[str]:
    """The verbs inside a verb, as "dataset check"."""
    folder = ROOT / "surgicai_vision" / "commands" / verb.replace("-", "_")
    names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    return {f"{verb} {name.replace('_', '-')}" for name in names}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_named_in_docs_exist(page: Path) -> None:
    named = [name for name in FILE.findall(page.read_text()) if not name.endswith("-v0")]
    assert not [name for name in named if not (ROOT / name).exists()]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_modules_named_in_docs_exist(page: Path) -> None:
    for name in sorted(set(MODULE.findall(page.read_text())) - GROUPS):
        module, _, attribute = name.rpartition(".")
        found = importlib.import_module(module)
        if not hasattr(found, attribute):
            assert importlib.util.find_spec(name) is not None, f"{page.name}: {name}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_row_of_a_table_has_as_many_cells_as_its_head(page: Path) -> None:
    """A row that was wrapped, or joined to another, is shown as text full of bars."""
    lines = page.read_text(encoding="utf-8").splitlines()
    broken = [line for line in lines if "|---" in line and not RULE.fullmatch(line.strip())]
    for index, line in enumerate(lines):
        if not RULE.fullmatch(line.strip()):
            continue
        for row in (lines[index - 1], *itertools.takewhile(str.strip, lines[index + 1 :])):
            if _cells(row) != _cells(line):
                broken.append(row)
    assert broken == []


def _cells(row: str) -> int:
    """The number of cells in a table's row; 0 if it is not a row."""
    text = row.strip()
    whole = text.startswith("|") and text.endswith("|")
    return len(re.findall(r"(?<!\\)\|", text)) - 1 if whole else 0
