"""Print code metrics: how the sources meet the limits that `CONTRIBUTING.md` sets.

    make figures

Only tracked Python files that are shipped are measured, not tests, examples or benchmarks. The exit
code is 1 if a binding limit is exceeded.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("surgicai_vision", "encoders", "policies", "lerobot_env_surgicai")
OURS = {"surgicai_vision", "encoders", "policies"}
WIDTH = 100
GERUND = re.compile(r"ing\.py$")
NOUNS = ("rendering.py", "training.py", "hole_crossing.py")


class Figure(NamedTuple):
    """A metric and its limit; a limit on size is for orientation only and does not bind."""

    name: str
    value: float
    limit: float
    binds: bool = True

    @property
    def is_within(self) -> bool:
        """Whether the value is within the limit."""
        return self.value <= self.limit


def sources() -> list[Path]:
    """Return the tracked Python files that are shipped."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    skipped = ("tests/", "examples/", "benchmarks/")
    paths = [name for name in listed.stdout.split() if not name.startswith(skipped)]
    return [ROOT / name for name in paths if (ROOT / name).is_file()]


def own_imports(tree: ast.AST) -> Iterator[ast.ImportFrom]:
    """Yield the imports of our own modules inside functions."""
    for function in ast.walk(tree):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            for node in ast.walk(function):
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
                    yield node


def is_packed(node: ast.AST) -> bool:
    """Return True if `node` assigns several values in parallel: `a, b = x, y`."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def figures() -> list[Figure]:
    """Return all metrics of the sources."""
    lines = 0
    package_lines = 0
    wide = 0
    pictures = 0
    anys = 0
    packed = 0
    local = 0
    gerunds = 0
    for path in sources():
        name = path.relative_to(ROOT).as_posix()
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        body = text.splitlines()
        lines += len(body)
        package_lines += len(body) if name.startswith(PACKAGES) else 0
        wide += sum(len(line) > WIDTH for line in body)
        if path != Path(__file__).resolve():
            pictures += sum("picture" in line.lower() for line in body)
        gerunds += bool(GERUND.search(name)) and path.name not in NOUNS
        for node in ast.walk(tree):
            anys += isinstance(node, ast.Name) and node.id == "Any"
            packed += is_packed(node)
        if "commands/" not in name:
            local += len(list(own_imports(tree)))
    loose = {path.name for path in (ROOT / "surgicai_vision").glob("*.py")}
    thousands = lines / 1000
    return [
        Figure("`Any` per 1,000 lines", round(anys / thousands, 1), 5),
        Figure("imports of our own modules inside functions outside commands/", local, 10),
        Figure(f"lines over {WIDTH} columns", wide, 0),
        Figure("parallel assignments per 1,000 lines", round(packed / thousands, 1), 2),
        Figure("module files named by a gerund (except rendering, training)", gerunds, 0),
        Figure("lines with 'picture'", pictures, 5),
        Figure("loose modules", len(loose - {"__init__.py", "__main__.py"}), 0),
        Figure("lines of the four packages", package_lines, 30_000, binds=False),
    ]


def main() -> int:
    """Print one line per metric."""
    found = figures()
    for figure in found:
        verdict = "" if figure.is_within else "  too many" if figure.binds else "  (orientation)"
        print(f"{figure.name:<64}{figure.value:>9,}  at most {figure.limit:,}{verdict}")
    return int(any(figure.binds and not figure.is_within for figure in found))


if __name__ == "__main__":
    sys.exit(main())
