"""`sweep`: encode, train and evaluate every cell of a grid, or rebuild a plan from scratch."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    DEVICE,
    DIRECTORY,
    EXECUTOR,
    IMAGE_SIZE,
    default_text,
)
from surgicai_vision.core.config import from_mapping
from surgicai_vision.core.errors import BadFile, UnknownName
from surgicai_vision.core.files import check_output, configs_folder, read_yaml
from surgicai_vision.core.words import plural
from surgicai_vision.experiments.plan_config import is_plan, read_plan
from surgicai_vision.experiments.sweep.grid import AXES, Grid
from surgicai_vision.experiments.sweep.rl_grid import RLGrid
from surgicai_vision.features.devices import find_device

if TYPE_CHECKING:
    from surgicai_vision.experiments.sweep.experiment import Experiment
    from surgicai_vision.experiments.sweep.selection import Choice

app = App(
    name="sweep",
    help_epilogue="""\
example:
  surgicai-vision sweep configs/sweep/smoke.yaml --out outputs/sweeps/smoke --json
a headline from scratch, for its first training seed; without --only, for all of them:
  surgicai-vision sweep procedure --only seed=0
reinforcement-learning algorithms:
  surgicai-vision sweep rl-demonstrations --only algo=td3-her-bc --only task=grasp
to try a file in minutes:
  surgicai-vision sweep procedure --demonstrations 5 --epochs 1 --episodes 2 --size 64""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `sweep`.

    Attributes:
        grid: YAML file of a grid or a plan, or the name of a shipped one (smoke).
        out: Folder to create or continue.
        only: Work only on these runs, by an axis of the grid or by condition; may be repeated for
            another axis; views are joined by +.
        demonstrations: Number of demonstrations per dataset, instead of the file's.
        epochs: Number of passes over the frames, instead of the recipes'.
        episodes: Number of starts per evaluation, instead of the file's.
        size: Height and width of images [px], instead of the file's.
        dry_run: Only list the runs, what is done already and about how long the rest takes.
        workers: Number of runs at a time; the results do not depend on it.
        attempts: How many times to start a run whose process is killed.
        device: Where to encode and train; auto uses a GPU if there is one.
    """

    grid: Annotated[str, Parameter(metavar="GRID.yaml")] = field(kw_only=False)
    out: Annotated[
        Path | None,
        DIRECTORY,
        default_text(
            "outputs/sweeps/<name of the file>, with -tried after it where --demonstrations, "
            "--epochs, --episodes or --size changes the file's"
        ),
    ] = None
    only: Annotated[
        tuple[str, ...], Parameter(metavar="AXIS=VALUE[,VALUE]"), default_text("all")
    ] = ()
    demonstrations: Annotated[int | None, COUNT, default_text("the file's")] = None
    epochs: Annotated[int | None, COUNT, default_text("the recipes'")] = None
    episodes: Annotated[int | None, COUNT, default_text("the file's")] = None
    size: Annotated[int | None, IMAGE_SIZE, default_text("the file's")] = None
    dry_run: bool = False
    workers: Annotated[int, COUNT] = folders.CORES
    attempts: Annotated[int, COUNT] = 3
    executor: Annotated[str, EXECUTOR] = "local"
    device: Annotated[
        str | None, DEVICE, default_text("encode on a GPU if there is one, train on the CPU")
    ] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Run the sweep, or list its runs."""
    from surgicai_vision.core.executor import RunContext, open_engine
    from surgicai_vision.evaluation.storage import GRID_FILE
    from surgicai_vision.experiments.sweep.driver import run_sweep
    from surgicai_vision.experiments.sweep.selection import read_choice

    if options.device is not None:
        find_device(options.device)
    path = grid_file(options.grid)
    whole = read_experiment(path)
    grid = whole.smaller(
        demonstrations=options.demonstrations,
        epochs=options.epochs,
        episodes=options.episodes,
        size=options.size,
    )
    choice = read_choice(options.only, grid.runs)
    name = path.stem if grid == whole else f"{path.stem}-tried"
    out = options.out or folders.OUTPUTS / "sweeps" / name
    check_output(out, may_resume=GRID_FILE)
    context = RunContext(options.workers, open_engine(options.executor), console.stage)
    if options.dry_run:
        return _list(grid, out, choice, options.workers, console)
    result = run_sweep(grid, out, context, options.attempts, choice, options.device)
    for line in result.pop("problems"):
        console.say(line)
    told = ", ".join(f"{result[name]} {name.replace('_', ' ')}" for name in COUNTS)
    console.say(f"{plural(result['runs'], 'run')}: {told}; {out}")
    failed = result["failed"] or result["failed_beside"]
    return {**result, "exit_code": 1 if failed else 0}


def _list(
    grid: "Experiment", out: Path, choice: "Choice", workers: int, console: Console
) -> dict[str, object]:
    """Print each run's state, and how long the rest takes if a finished run can tell."""
    from surgicai_vision.evaluation.storage import GRID_FILE
    from surgicai_vision.experiments.sweep.driver import continued
    from surgicai_vision.experiments.sweep.estimate import estimate
    from surgicai_vision.experiments.sweep.plan import NOT_RUN, STATES, lacking, plan

    if (out / GRID_FILE).exists():
        continued(grid, out)
    states = plan(grid, out, choice)
    for state in states:
        line = f"{state.state:<8} {state.key}  {state.where}"
        again = state.reason and state.state != NOT_RUN
        console.say(f"{line}: {state.reason}" if again else line)
    for reason, runs in lacking(states).items():
        console.say(f"not run, {plural(len(runs), 'run')}: {reason}")
    counts = {
        name.replace(" ", "_"): sum(state.state == name for state in states) for name in STATES
    }
    seconds = estimate(states, out, workers)
    told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())
    rest = (
        "how long they take is known once the first has finished"
        if seconds is None
        else f"about {_duration(seconds)} with {workers} workers, judging by the finished ones"
    )
    console.say(f"{plural(len(states), 'run')}: {told}; {rest}.")
    return {"runs": len(states), **counts, "seconds": seconds, "dry_run": True}


COUNTS = ("done", "cached", "failed", "not_run", "left")


def _duration(seconds: float) -> str:
    """Return a duration in the largest unit that fits."""
    for size, unit in ((86400, "days"), (3600, "hours"), (60, "minutes")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} seconds"


def grid_file(given: str) -> Path:
    """Find a grid: a file, or the name or repository path of a shipped one."""
    path = Path(given)
    folder = configs_folder() / "sweep"
    if path.is_file():
        return path
    shipped = {file.stem: file for file in folder.glob("*.yaml")}
    if given in (path.stem, f"configs/sweep/{path.name}") and path.stem in shipped:
        return shipped[path.stem]
    if path.suffix or path.parent != Path():
        raise BadFile(f"There is no grid {path}; shipped ones: {', '.join(sorted(shipped))}.")
    raise UnknownName("grid", given, shipped)


def read_experiment(path: Path) -> "Experiment":
    """Read a grid, a plan (which lists its policies) or a grid over algorithms."""
    table = read_yaml(path)
    if "algo" in table:
        return from_mapping(RLGrid, _with_lists(table), str(path))
    return read_plan(path) if is_plan(table) else read_grid(path)


def _with_lists(table: dict[str, object]) -> dict[str, object]:
    """Return a table with its axes as lists; one value may be written without brackets."""
    return {
        key: [value] if key in AXES and type(value) in (str, int) else value
        for key, value in table.items()
    }


def read_grid(path: Path) -> Grid:
    """Read a grid.

    A list of views may be written as "front,back", and an axis of one value without brackets.
    """
    table = _with_lists(read_yaml(path))
    views = table.get("view")
    if isinstance(views, list):
        table["view"] = [_listed(view) for view in views]
    ablations = table.get("ablation")
    if isinstance(ablations, list):
        table["ablation"] = [_ablation(ablation) for ablation in ablations]
    for name in ("task", "encoder", "view"):
        table.setdefault(name, [])
    return from_mapping(Grid, table, str(path))


def _listed(value: object) -> object:
    """Return "front,back" as a list."""
    return value.split(",") if isinstance(value, str) else value


def _ablation(table: object) -> object:
    """Return an ablation with its comma lists split."""
    if not isinstance(table, dict):
        return table
    return {
        key: _listed(value) if key in ("view", "change") else value for key, value in table.items()
    }
