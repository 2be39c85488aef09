"""The command line: `lerobot-salvage check|repair DIR`.

Exit codes: 0 whole or repaired, 1 problems were found or the work failed, 2 wrong input.
"""

import dataclasses
import json
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter

from lerobot_salvage.check import check_dataset
from lerobot_salvage.repair import repair_dataset
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.os_errors import drop_output, of_os_error
from surgicai_vision.core.errors import InputError, SurgicaiError

PROGRAM = "lerobot-salvage"
Dataset = Annotated[Path, Parameter(metavar="DIR")]
Json = Annotated[bool, Parameter(name="--json", negative=(), show_default=False)]

app = App(
    name=PROGRAM,
    help="Check any LeRobot v3 dataset, and repair a broken one.",
    version=lambda: f"{PROGRAM} {version('lerobot_salvage')}",
    help_format="plaintext",
    result_action="return_value",
    print_error=False,
    exit_on_error=False,
)


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        return app(sys.argv[1:] if arguments is None else arguments) or 0
    except CycloptsError as error:
        return _fail(InputError(f"{error} See `{PROGRAM} --help`."))
    except SurgicaiError as error:
        return _fail(error)
    except KeyboardInterrupt:
        return _fail(SurgicaiError("interrupted; the dataset is unchanged."))
    except BrokenPipeError:
        drop_output()
        return 1
    except OSError as error:
        return _fail(of_os_error(error))


def _fail(error: SurgicaiError) -> int:
    """Print an error in one line and return its exit code."""
    print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
    return error.exit_code


@app.command
def check(dataset: Dataset, /, *, as_json: Json = False) -> int:
    """Read a whole dataset and print one line per problem.

    Args:
        dataset: Any LeRobot v3 dataset.
        as_json: Print the result as one JSON object, the last line of stdout.
    """
    console = Console()
    with console.stage("checking") as progress:
        report = check_dataset(dataset, progress)
    for problem in report.problems:
        console.say(problem)
    count = len(report.problems)
    verdict = "whole" if report.ok else f"{count} problems; `{PROGRAM} repair` keeps what is whole"
    console.say(f"{report.episodes} episodes, {report.frames} frames: {verdict}")
    if as_json:
        console.say(json.dumps({**dataclasses.asdict(report), "ok": report.ok}, sort_keys=True))
    return 0 if report.ok else 1


@app.command
def repair(
    dataset: Dataset,
    /,
    *,
    out: Annotated[Path | None, Parameter(metavar="DIR2")] = None,
    as_json: Json = False,
) -> int:
    """Keep the longest whole prefix of a broken dataset.

    Args:
        dataset: Any LeRobot v3 dataset.
        out: Folder to create. By default DIR is replaced, and the original stays as DIR.broken.
        as_json: Print the result as one JSON object, the last line of stdout.
    """
    console = Console()
    with console.stage("verifying", "episodes") as progress:
        result = repair_dataset(dataset, out, progress)
    for problem in result.problems:
        console.say(problem)
    if result.original is None:
        console.say(
            f"nothing to repair: {result.episodes} episodes, {result.frames} frames in "
            f"{result.path} are whole"
        )
    else:
        kept = f"{result.episodes} of {result.claimed} episodes, {result.frames} frames kept"
        console.say(f"{kept}: {result.path} (original: {result.original})")
    if as_json:
        console.say(json.dumps(dataclasses.asdict(result), sort_keys=True, default=str))
    return 0


if __name__ == "__main__":
    sys.exit(main())
