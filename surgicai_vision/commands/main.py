"""The command line: `surgicai-vision COMMAND [OPTIONS]`, built on cyclopts.

Exit codes: 0 done, 1 the work failed or was interrupted, 2 wrong input, 143 ended by SIGTERM.
Deliberate errors (`SurgicaiError`) and wrong input print one line without a traceback. A command's
module, and what it needs, is imported only when that command runs, so `--help` is instant.
"""

import io
import json
import os
import signal
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, Group, Parameter
from cyclopts.argument import Argument, ArgumentCollection
from cyclopts.exceptions import (
    MissingArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)
from cyclopts.help import DefaultFormatter, HelpPanel, InlineText
from rich.console import Console, ConsoleOptions
from rich.text import Text

from surgicai_vision.commands import COMMANDS, PROGRAM, register
from surgicai_vision.commands.options import from_file, split_comma_lists
from surgicai_vision.commands.os_errors import drop_output, of_os_error
from surgicai_vision.core.errors import INTERRUPTED, InputError, SurgicaiError, UnknownName
from surgicai_vision.core.processes import Terminated, raise_on_terminate

TITLE = (
    "Image-based imitation learning for robotic suturing: "
    "scene → env → demos → dataset → features → policy → evaluation → report"
)
TERMINATED = 128 + signal.SIGTERM
"""Exit code after SIGTERM, as a shell reports it."""
EVERYWHERE = Group("Options of every command", sort_key=1)


class OneParagraph(DefaultFormatter):
    """Help panels whose texts wrap at the edge of the window, not where their docstrings do."""

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print a panel, with each description's lines joined."""
        for entry in panel.entries:
            match entry.description:
                case InlineText(primary_renderable=Text() as text):
                    text.plain = " ".join(text.plain.split())
        super().__call__(console, options, panel)


app = App(
    name=PROGRAM,
    help=TITLE,
    version=lambda: f"{PROGRAM} {version(PROGRAM)}",
    default_parameter=Parameter(negative_iterable=(), show_env_var=False),
    help_format="plaintext",
    help_formatter=OneParagraph(),
    console=Console(soft_wrap=True),  # examples are not wrapped at the edge of the window
    result_action="return_value",
    print_error=False,
    exit_on_error=False,
)
"""All commands. Its `meta` app takes `--config` and `--json`, then parses and runs the command."""
register(app, COMMANDS)
app.meta.config = ()
app.meta.suppress_keyboard_interrupt = False


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return its exit code."""
    for name in (
        "HF_DATASETS_DISABLE_PROGRESS_BARS",
        "HF_HUB_DISABLE_PROGRESS_BARS",
        "HF_HUB_DISABLE_TELEMETRY",
    ):
        os.environ.setdefault(name, "1")  # we show our own progress bars, and send no telemetry
    raise_on_terminate()
    _show_what_can_be_shown()
    try:
        return app.meta(sys.argv[1:] if arguments is None else arguments) or 0
    except CycloptsError as error:
        return _fail(explain(error))
    except SurgicaiError as error:
        return _fail(error)
    except KeyboardInterrupt as interrupt:
        print(f"{PROGRAM}: {INTERRUPTED}", file=sys.stderr)
        return TERMINATED if isinstance(interrupt, Terminated) else 1
    except BrokenPipeError:
        drop_output()
        return 1
    except OSError as error:
        return _fail(of_os_error(error))


def _show_what_can_be_shown() -> None:
    """Print `?` for a character that the output's encoding lacks, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


@app.meta.default
def _run(
    *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    config: Annotated[Path | None, Parameter(metavar="FILE.yaml", group=EVERYWHERE)] = None,
    as_json: Annotated[
        bool, Parameter(name="--json", negative=(), show_default=False, group=EVERYWHERE)
    ] = False,
) -> int:
    """Parse and run one command.

    Args:
        words: The command line without the two options below.
        config: Take options from this file; those on the command line override it.
        as_json: Print the result as one JSON object, the last line of stdout.
    """
    app.config = (split_comma_lists, *([from_file(config)] if config else []))
    command, bound, left_out = app.parse_args(words)
    services = {name: make() for name, make in left_out.items()}
    result: Mapping[str, object] | None = command(*bound.args, **bound.kwargs, **services)
    if result is None:  # no command was named, so its help was shown
        return 2
    if as_json:
        print(json.dumps(result, sort_keys=True), flush=True)
    return 1 if result.get("exit_code") else 0


def _fail(error: SurgicaiError) -> int:
    """Print an error in one line and return its exit code."""
    print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
    return error.exit_code


def explain(error: CycloptsError) -> InputError:
    """Return an error of cyclopts as one of ours, with the nearest name suggested."""
    chain = " ".join(error.command_chain or ())
    common = app.meta.assemble_argument_collection()
    match error:
        case UnknownCommandError(unused_tokens=[given, *_], app=App() as group):
            dashed = given.startswith("-")
            allowed = [name for name in group if name.startswith("-") == dashed]
            allowed += _names(common) if dashed else []
            return UnknownName(f"command of {chain}" if chain else "command", given, allowed)
        case UnknownOptionError(token=token, argument_collection=own):
            given = (token.keyword or token.value).partition("=")[0]
            return UnknownName("option", given, (*_names(own), *_names(common), "--help"))
        case UnusedCliTokensError(unused_tokens=[given, *_]):
            problem = f"unexpected argument '{given}'"
        case MissingArgumentError(keyword=str() as option):
            problem = f"{option} needs a value"
        case MissingArgumentError(argument=Argument(index=index, parameter=parameter, name=name)):
            option = "" if index is not None else name
            problem = f"{option} {parameter.metavar or ''}".strip() + " is missing"
        case _:
            error.verbose = False
            problem = str(error).replace('"', "'").rstrip(".")
    return InputError(f"{problem}; see `{PROGRAM} {f'{chain} '.lstrip()}--help`.")


def _names(options: ArgumentCollection) -> list[str]:
    """Return the names of options that `--help` shows."""
    return [name for option in options if option.show for name in option.names]


if __name__ == "__main__":
    sys.exit(main())
