"""The command line: `surgicai-vision VERB [options]`.

Exit codes: 0 done, 1 the work failed or was interrupted, 2 wrong input, 143 ended by SIGTERM.
Errors made on purpose (`SurgicaiError`) are one line without a traceback. A verb's module, and what
it needs, is imported only when that verb runs, so `--help` is instant.
"""

import argparse
import importlib
import json
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, final

from surgicai_vision.commands import VERBS, module_name
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import add_arguments, build, nearest_option
from surgicai_vision.core.errors import InputError, SurgicaiError, UnknownName
from surgicai_vision.core.processes import Terminated, raise_on_terminate

PROGRAM = "surgicai-vision"
TITLE = (
    "Image-based imitation learning for robotic suturing:\n"
    "scene → env → demos → dataset → features → policy → evaluation → report"
)
INTERRUPTED = "interrupted; run the same command again to continue"
TERMINATED = 128 + signal.SIGTERM
"""Exit code after SIGTERM, as a shell gives it."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return its exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    for name in (
        "HF_DATASETS_DISABLE_PROGRESS_BARS",
        "HF_HUB_DISABLE_PROGRESS_BARS",
        "HF_HUB_DISABLE_TELEMETRY",
    ):
        os.environ.setdefault(
            name, "1"
        )  # the bars are ours; nothing of a run is reported to anyone
    raise_on_terminate()
    try:
        return _dispatch(arguments)
    except SurgicaiError as error:
        print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt as interrupt:
        print(f"{PROGRAM}: {INTERRUPTED}", file=sys.stderr)
        return TERMINATED if isinstance(interrupt, Terminated) else 1
    except BrokenPipeError:
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # or Python complains at exit
        return 1
    except OSError as error:
        if error.filename is None:
            raise
        print(f"{PROGRAM}: error: {error.filename}: {error.strerror}.", file=sys.stderr)
        return 1


def _dispatch(arguments: list[str]) -> int:
    if arguments[:1] == ["--version"]:
        from importlib.metadata import version

        print(f"{PROGRAM} {version(PROGRAM)}")
        return 0
    return _choose("", VERBS, TITLE, arguments)


def _choose(group: str, verbs: Mapping[str, str], title: str, arguments: list[str]) -> int:
    """Find the verb among `verbs`, in the group's own where it has them, and run it."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_usage(group, verbs, title))
        return 0 if arguments else 2
    verb = arguments[0]
    if verb.startswith("-"):
        raise UnknownName(
            "option before the verb", verb, ("--help",) if group else ("--help", "--version")
        )
    if verb not in verbs:
        raise UnknownName(f"verb of {group}" if group else "verb", verb, verbs)
    name = f"{group} {verb}".strip()
    module = importlib.import_module(module_name(name))
    if hasattr(module, "VERBS"):
        return _choose(
            name, module.VERBS, f"{verbs[verb][0].upper()}{verbs[verb][1:]}.", arguments[1:]
        )
    return _run(name, verbs[verb], module, arguments[1:])


def _run(verb: str, text: str, module: Any, arguments: list[str]) -> int:
    """Parse one verb's options, run it and print its result."""
    parser = _parser(verb, text, module)
    for text in arguments:
        if text.startswith("--") and text.split("=")[0] not in parser._option_string_actions:
            raise nearest_option(text, parser)
    try:
        known, extra = parser.parse_known_args(arguments)
    except _HelpShown:
        return 0
    if extra:
        raise InputError(f"{verb}: unexpected argument '{extra[0]}'; see `{parser.prog} --help`.")
    given = vars(known)
    as_json, config = given.pop("json", False), given.pop("config", None)
    options = build(module.Options, given, config)
    result: dict[str, Any] = module.run(options, Console())
    if as_json:
        print(json.dumps(result, sort_keys=True), flush=True)
    return int(result.get("exit_code", 0))


def _usage(group: str, verbs: Mapping[str, str], title: str) -> str:
    program = f"{PROGRAM} {group}".strip()
    width = max(map(len, verbs))
    lines = [
        f"usage: {program} VERB [options]",
        "",
        title,
        "",
        "verbs:",
        *(f"  {verb:<{width}}  {text}" for verb, text in verbs.items()),
        "",
        f"`{program} VERB --help` shows a verb's options, defaults and an example.",
    ]
    if not group:
        lines.append(f"`{PROGRAM} --version` prints the version.")
    return "\n".join(lines)


class _HelpShown(Exception):
    """`--help` was printed."""


@final
class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one `InputError` line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(
            f"{self.prog.removeprefix(PROGRAM).strip()}: {message}; see `{self.prog} --help`."
        )

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        raise _HelpShown


def _parser(verb: str, text: str, module: Any) -> argparse.ArgumentParser:
    parser = _Parser(
        prog=f"{PROGRAM} {verb}",
        description=f"{text[0].upper()}{text[1:]}.",
        epilog="\n\n".join(
            [f"example:\n  {module.EXAMPLE}", *filter(None, [getattr(module, "NOTES", "")])]
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_arguments(parser, module.Options)
    parser.add_argument(
        "--config",
        type=Path,
        default=argparse.SUPPRESS,
        metavar="FILE.yaml",
        help="take options from this file; those given here override it",
    )
    parser.add_argument(
        "--json",
        action="store_true",
        default=argparse.SUPPRESS,
        help="print the result as one JSON object, the last line of stdout",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
