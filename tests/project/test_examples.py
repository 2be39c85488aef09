"""Examples: each script and notebook runs as it stands, in small settings; scripts are short."""

import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import nbformat
import pytest
from nbclient import NotebookClient

from surgicai_vision.core.tasks import TASKS
from surgicai_vision.features.encoders import ENCODERS

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
LINES = 60
"""Most lines that a script may have."""
HERE = ["--workers", "0"]
"""Work in this process: starting another takes longer than the work."""
SMALL = {
    "environment": ["--task", "pullout"],
    "record_and_render": ["--task", "pullout", "--episodes", "1", "--size", "32", *HERE],
    "train_in_python": [
        *("--task", "pullout", "--demonstrations", "2", "--encoder", "random-conv"),
        *("--epochs", "1", "--episodes", "1", *HERE),
    ],
    "own_encoder": ["--demonstrations", "2", "--epochs", "1", "--episodes", "1", *HERE],
    "own_task": [],
    "compare_policies": ["expert", "zero", "--task", "pullout", "--episodes", "1"],
}
"""Script → arguments that make it small."""
SAYS = {
    "environment": "replayed from step 20, the same final state: True",
    "record_and_render": "1 episodes",
    "train_in_python": "proprioception-paper+epochs=1: ",
    "own_encoder": "thumbnail-front-paper+epochs=1: ",
    "own_task": "steps, success: True\nstart 2: ",
    "compare_policies": "expert against zero: 1 : 0 starts, p = 1 (Holm)",
}
"""Script → what it prints."""
SETTINGS = """\
TASK = "pullout"
DEMONSTRATIONS = 2
ENCODER = "random-conv"
EPOCHS = 1
EPISODES = 1
SIZE = 32
WORKERS = 1
OUT = "outputs/notebooks"
STRENGTHS = (0.0, 1.0)
"""


@pytest.fixture
def _forget() -> Iterator[None]:
    """Forget afterwards whatever an example registers."""
    known = {registry: registry.names() for registry in (TASKS, ENCODERS)}
    ids = set(gymnasium.registry)
    yield
    for registry, names in known.items():
        for name in set(registry.names()) - set(names):
            registry.unregister(name)
    for new in set(gymnasium.registry) - ids:
        del gymnasium.registry[new]


def scripts() -> list[str]:
    return sorted(path.stem for path in EXAMPLES.glob("*.py"))


def test_every_script_is_run_and_every_example_listed() -> None:
    assert scripts() == sorted(SMALL)
    listed = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    examples = [*EXAMPLES.glob("*.py"), *EXAMPLES.glob("*.ipynb")]
    assert not [path.name for path in examples if f"| `{path.name}` |" not in listed]


@pytest.mark.usefixtures("_forget")
@pytest.mark.parametrize("name", SMALL)
def test_a_script_runs_as_it_stands(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *SMALL[name]])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert SAYS[name] in capsys.readouterr().out


@pytest.mark.parametrize("name", scripts())
def test_a_script_is_short(name: str) -> None:
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= LINES


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs_as_it_stands(path: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    (settings,) = (c for c in notebook.cells if "parameters" in c.metadata.get("tags", ()))
    settings.source = SETTINGS
    assert not any(cell.get("outputs") for cell in notebook.cells), "notebooks are kept without"
    client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
