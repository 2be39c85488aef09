"""Sphinx extension: pages that every build generates again, in docs/generated.

* `commands/`: one page per verb, from the command line's own parser.
* `api/`: one page per package for autodoc, in the order of the flow.
* `examples/`: each script and notebook of examples/ as a page.
"""

import ast
import contextlib
import io
import json
from collections.abc import Iterable, Iterator
from pathlib import Path

from cyclopts import App
from cyclopts.argument import Argument
from sphinx.application import Sphinx

from surgicai_vision.commands import COMMANDS, PROGRAM
from surgicai_vision.commands.main import app as command_line
from surgicai_vision.commands.main import main

ORDER = (
    "environment",
    "record_and_render",
    "train_in_python",
    "compare_policies",
    "own_encoder",
    "own_task",
)
"""Scripts in reading order; scripts not listed here come after them."""
INNER = (
    "surgicai_vision.scene.visual.",
    "surgicai_vision.demos.imports.",
    "surgicai_vision.demos.dmp.",
    "surgicai_vision.teleoperation.",
    "surgicai_vision.report.",
    "surgicai_vision.experiments.sweep.",
)
"""Modules that only the package itself uses; they have no section in the reference."""
ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "surgicai_vision.core": "shared by all stages: names, config, errors, files and the executor",
    "surgicai_vision.scene": "scene: the arms, the needle, the thread, the phantom, the cameras",
    "surgicai_vision.envs": "env: the gymnasium environments",
    "surgicai_vision.demos": "demos: demonstrators, recording, imports",
    "surgicai_vision.teleoperation": "demos: teleoperation with keyboard and gamepad",
    "surgicai_vision.dataset": "dataset: demonstrations rendered into LeRobot datasets",
    "surgicai_vision.features": "features: encoders by name, the cache, the probe",
    "encoders": "features: the frozen encoders themselves",
    "surgicai_vision.training": "policy: training and checkpoints",
    "surgicai_vision.detection": "detection: the jaws in whole images, by which crops are aimed",
    "policies": "policy: the policies themselves",
    "surgicai_vision.evaluation": "evaluation: rollouts, measures, statistics, robustness",
    "surgicai_vision.rl": "reinforcement and offline learning, with the libraries of the extra rl",
    "surgicai_vision.robot": "a dVRK, simulated or driven, over CRTK with ROS 2 messages",
    "surgicai_vision.report": "report: one page from stored results",
    "surgicai_vision.experiments": "whole runs: quickstart, sweep, DAgger",
}
"""Package → its description, in the order of the flow."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before Sphinx looks for its sources."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(app: Sphinx) -> None:
    """Write every generated page whose content has changed, and remove stale ones."""
    folder = Path(app.srcdir) / "generated"
    pages = dict([*command_pages(), *api_pages(), *example_pages()])
    for stale in set(folder.rglob("*.*")) - {folder / name for name in pages}:
        stale.unlink()
    for name, text in pages.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def toctree(entries: Iterable[str]) -> str:
    """Return the entries of the sidebar in MyST; the page itself has them in a table."""
    lines = "\n".join(entries)
    return f"```{{toctree}}\n:hidden:\n\n{lines}\n```\n"


# ---- the command line


def command_pages() -> Iterator[tuple[str, str]]:
    """Yield (path, text) of the verbs' pages and of the page that lists them."""
    rows = "\n".join(
        f"| [`{verb}`]({verb}.md) | {markdown(text)} |" for verb, text in COMMANDS.items()
    )
    shared = options_of(
        argument
        for argument in command_line.meta.assemble_argument_collection(parse_docstring=True)
    )
    yield (
        "commands/index.md",
        f"""\
# Commands

Every verb of `{PROGRAM}`, in the order of the flow. These pages are generated from the command
line's own parser when the site is built: they show what `{PROGRAM} VERB --help` prints.

| verb | what it does |
|---|---|
{rows}

## Options of every command

{shared}

Exit codes: 0 done, 1 the work failed or was interrupted, 2 wrong input, 143 ended by SIGTERM.

{toctree(COMMANDS)}""",
    )
    for verb, text in COMMANDS.items():
        yield f"commands/{verb}.md", command_page(verb, text, command_line[verb], 1)


def command_page(words: str, text: str, command: App, level: int) -> str:
    """Return the page of a verb, or the section of a subcommand.

    Args:
        words: the verb, e.g. "dataset check".
        text: what it does.
        command: its app.
        level: the level of its heading.
    """
    parts = [f"{'#' * level} {words}", markdown(text)]
    inner = {name: command[name] for name in command if not name.startswith("-")}
    if inner:
        parts += [
            command_page(f"{words} {name}", part.help, part, level + 1)
            for name, part in inner.items()
        ]
        return "\n\n".join(parts) + "\n"
    parts.append(f"```text\n{usage(words)}\n```")
    example = (command.help_epilogue or "").partition("\n")[2]
    if example.strip():
        lines = "\n".join(line.removeprefix("  ") for line in example.splitlines())
        parts.append(f"For example:\n\n```text\n{lines.strip()}\n```")
    shown = options_of(command.assemble_argument_collection(parse_docstring=True))
    if shown:
        parts += [f"{'#' * (level + 1)} Options", shown]
    parts.append("See also the [options of every command](index.md#options-of-every-command).")
    return "\n\n".join(parts) + "\n"


def usage(words: str) -> str:
    """Return the first line of `VERB --help`."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        main([*words.split(), "--help"])
    lines = (line for line in printed.getvalue().splitlines() if line.startswith("Usage:"))
    return next(lines).removeprefix("Usage: ")


def options_of(arguments: Iterable[Argument]) -> str:
    """Return the options that `--help` shows, as a definition list."""
    return "\n\n".join(option(argument) for argument in arguments if argument.show)


def option(argument: Argument) -> str:
    """Return one option with its name, metavar, help, choices and default."""
    flag = argument.resolved_hint is bool
    metavar = argument.parameter.metavar
    name = argument.name
    if argument.index is not None:
        name = metavar or name.lstrip("-").upper()
    elif flag:
        negatives = [other for other in argument.names if other.startswith("--no-")]
        name = ", ".join([name, *negatives])
    elif metavar or not flag:
        name = f"{name} {metavar or value_name(argument)}"
    facts = []
    if argument.required:
        facts.append("Required.")
    choices = argument.parameter.choices or ()
    if choices:
        facts.append("One of " + ", ".join(f"`{choice}`" for choice in choices) + ".")
    default = default_of(argument)
    if default:
        facts.append(f"Default: {default}.")
    help_text = " ".join((argument.parameter.help or "").split())
    return f"`{name}`\n: {' '.join([markdown(help_text), *facts]).strip() or '–'}"


def value_name(argument: Argument) -> str:
    """Return the placeholder for an option's value if it has no metavar."""
    return "CHOICE" if argument.parameter.choices else argument.name.lstrip("-").upper()


def default_of(argument: Argument) -> str:
    """Return an option's default as it would be typed, or what happens without the option."""
    shown = argument.parameter.show_default
    if isinstance(shown, str):
        return markdown(shown) if " " in shown else f"`{shown}`"
    default = argument.field_info.default
    if shown is False or default in (None, argument.field_info.empty, ()):
        return ""
    if isinstance(default, bool):
        return "yes" if default else "no"
    text = shown(default) if callable(shown) else str(default)
    return f"`{text}`"


def markdown(text: str) -> str:
    """Return plain text, escaped so that Markdown shows it unchanged."""
    for sign in ("\\", "<", "*", "_", "|", "[", "]", "$"):
        text = text.replace(sign, f"\\{sign}")
    return text


# ---- the Python reference


def api_pages() -> Iterator[tuple[str, str]]:
    """Yield (path, text) of the packages' pages and of the page that lists them."""
    rows = "\n".join(
        f"| [`{package}`]({package}.rst) | {text} |" for package, text in PACKAGES.items()
    )
    entries = [f"{short(package)} <{package}>" for package in PACKAGES]
    yield (
        "api/index.md",
        f"""\
# Python reference

Every package's public modules, from their docstrings; [](../../python.md) lists the few that most
programs need.

| package | stage |
|---|---|
{rows}

{toctree(entries)}""",
    )
    for package in PACKAGES:
        yield f"api/{package}.rst", package_page(package)


def package_page(package: str) -> str:
    """Return a package's page: its docstring, then one section per module, nested ones too."""
    parts = [heading(package, "="), automodule(package)]
    for module in modules_of(package):
        parts += [heading(module.removeprefix(f"{package}."), "-"), automodule(module)]
    return "\n\n".join(parts) + "\n"


def short(package: str) -> str:
    """Return a package's name in the table of contents."""
    return package.removeprefix("surgicai_vision.")


def modules_of(package: str) -> list[str]:
    """Return the public modules below a package, found by walking its folder."""
    folder = ROOT / package.replace(".", "/")
    paths = [path.relative_to(ROOT).with_suffix("") for path in folder.rglob("*.py")]
    modules = [".".join(path.parts).removesuffix(".__init__") for path in paths]
    return sorted(
        name
        for name in modules
        if name != package and "._" not in name and not name.startswith(INNER)
    )


def heading(text: str, line: str) -> str:
    """Return a heading in reStructuredText."""
    return f"{text}\n{line * len(text)}"


def automodule(module: str) -> str:
    """Return the directive that documents what a module defines itself."""
    return f".. automodule:: {module}\n   :members:\n   :show-inheritance:\n   :ignore-module-all:"


# ---- the examples


def example_pages() -> Iterator[tuple[str, str]]:
    """Yield (path, text) of a page for each example, and of the page that lists them."""
    scripts = sorted((ROOT / "examples").glob("*.py"), key=place)
    notebooks = sorted((ROOT / "examples").glob("*.ipynb"))
    titles = {}
    for path in scripts:
        source = path.read_text(encoding="utf-8")
        titles[path] = (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]
        text = f"# {path.name}\n\n`examples/{path.name}`\n\n```python\n{source}```\n"
        yield f"examples/{path.stem}.md", text
    for path in notebooks:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        text = "\n\n".join(cell_text(cell) for cell in cells)
        titles[path] = text.partition("\n")[0].lstrip("# ")
        heading, _, body = text.partition("\n")
        yield f"examples/{path.stem}.md", f"{heading}\n\n`examples/{path.name}`\n{body}\n"
    rows = "\n".join(
        f"| [`{path.name}`]({path.stem}.md) | {title} |" for path, title in titles.items()
    )
    yield (
        "examples/index.md",
        f"""\
# Examples

Short programs that use the public Python API; the tests run each of them. They are in `examples/`:

| example | what it shows |
|---|---|
{rows}

{toctree(path.stem for path in titles)}""",
    )


def place(path: Path) -> tuple[int, str]:
    """Return a script's sort key: its place in `ORDER`, or after those, then its name."""
    known = path.stem in ORDER
    return (ORDER.index(path.stem) if known else len(ORDER), path.stem)


def cell_text(cell: dict[str, object]) -> str:
    """Return a notebook's cell in Markdown."""
    source = "".join(cell["source"])
    return f"```python\n{source}\n```" if cell["cell_type"] == "code" else source
