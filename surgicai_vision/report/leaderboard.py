"""Leaderboard: rows that others measured, checked one by one, as one static page.

Interface:

* `make_row(folder, entry) -> Row`: the row of an evaluation's folder, sealed by its digest.
* `read_row(path) -> Row`: read a row's file; nothing in it is executed.
* `problem(row) -> str`: why a row is not accepted, or "".
* `write_leaderboard(folder, out) -> Board`: check every `*.json` below a folder, write the page.

A row is accepted if all of the following hold; successes are counted from its episodes, and no
summary is read:

* its digest is that of its content;
* its scene is the present one, by the hash of the compiled model;
* its env is the task's default, or that of the shifted condition: everything `robustness` shifts,
  all at once and at half strength;
* its starts are the first `FEWEST` or more seeds of the bank of test starts, each once and in
  order, so that any two rows of a task and a condition are paired.

No file can show that a row was measured at all, so the page says by whom, and gives the command
that repeats it.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from surgicai_vision.core import percentages
from surgicai_vision.core.config import JSON, TaskConfig, digest, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, check_at_least, check_finite
from surgicai_vision.core.files import write_bytes, write_json
from surgicai_vision.core.names import SUTURE, TEST_SEED
from surgicai_vision.core.tasks import task_names
from surgicai_vision.evaluation.hierarchical_config import MAX_STEPS, advance_of
from surgicai_vision.evaluation.robustness.axes import ALL, AXES, shifted_config
from surgicai_vision.evaluation.statistics import clopper_pearson, mcnemar
from surgicai_vision.evaluation.storage import read_evaluation, read_rows
from surgicai_vision.scene import build_scene
from surgicai_vision.training.run_config import RunConfig

FORMAT = 1
FEWEST = 100
"""Minimum number of starts of a row."""
HALF = 0.5
CLEAN = "clean"
SHIFTED = "shifted"
LARGEST = 1 << 20
"""Maximum size of a row's file in bytes; a complete row has a few kilobytes."""


@dataclass(frozen=True)
class Entry:
    """What the person who measured a row says about it.

    Attributes:
        name: the policy's name on the page.
        by: who measured it.
        link: where its code or paper is; "" for nowhere.
        minutes: minutes of training; None if not known.
        hardware: what it was trained on.
        note: anything else that a reader must know.
    """

    name: str
    by: str
    link: str = ""
    minutes: float | None = None
    hardware: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        if not self.name.strip() or not self.by.strip():
            raise InputError("A row needs a name and who measured it; give --name and --by.")
        if self.link and not self.link.startswith("https://"):
            raise InputError(f"link is {self.link}; it must begin with https://.")
        if self.minutes is not None:
            check_at_least(0, minutes=self.minutes)
            check_finite(minutes=self.minutes)
        for words in (self.name, self.by, self.link, self.hardware, self.note):
            if len(words) > 300:
                raise InputError(f"'{words[:40]}…' has {len(words)} characters; 300 at most.")


@dataclass(frozen=True)
class Row:
    """A row of the leaderboard.

    Attributes:
        entry: what is said about it.
        run: what was evaluated.
        scene_hash: hash of the compiled scene.
        policy_sha256: hash of the policy's weights; "" for code that has none.
        command: the command that evaluated it.
        versions: versions of the packages it was evaluated with.
        seeds: start of each episode.
        successes: whether each episode was a success.
        steps: control steps of each episode.
        digest: digest of all of the above.
        format: version of this layout.
    """

    entry: Entry
    run: RunConfig
    scene_hash: str
    policy_sha256: str
    command: str
    versions: dict[str, str | None]
    seeds: tuple[int, ...]
    successes: tuple[bool, ...]
    steps: tuple[int, ...]
    digest: str = ""
    format: int = FORMAT

    def __post_init__(self) -> None:
        if not all(isinstance(version, str | None) for version in self.versions.values()):
            raise InputError("versions must be texts: package → version.")

    @property
    def condition(self) -> str:
        """`CLEAN` or `SHIFTED`."""
        return SHIFTED if self.run.shift else CLEAN

    def sealed(self) -> "Row":
        """Return the row with the digest of its content."""
        content = to_mapping(replace(self, digest=""))
        run = to_mapping(self.run)
        if not self.run.detector:  # rows that were sealed before it existed keep their digest
            del run["detector"]
        return replace(self, digest=digest({**content, "run": run}))


@dataclass(frozen=True)
class Board:
    """The leaderboard of a folder.

    Attributes:
        page: where it was written.
        taken: rows that are on it.
        refused: file → why its row is not.
    """

    page: Path
    taken: tuple[Row, ...]
    refused: dict[str, str]


def make_row(folder: Path, entry: Entry) -> Row:
    """Return the row of an evaluation's folder.

    Raises:
        BadFile: there is no complete evaluation.
        InputError: the row would not be accepted.
    """
    evaluation = read_evaluation(folder)
    rows = read_rows(folder)
    about = evaluation.about
    checkpoint = about.get("checkpoint") or {}
    row = Row(
        entry,
        evaluation.run,
        str(about.get("scene_hash", "")),
        str(checkpoint.get("policy_sha256") or ""),
        str(about.get("command", "")),
        dict((about.get("provenance") or {}).get("packages") or {}),
        tuple(int(each["seed"]) for each in rows),
        tuple(bool(each["success"]) for each in rows),
        tuple(int(each["steps"]) for each in rows),
    ).sealed()
    wrong = problem(row)
    if wrong:
        raise InputError(f"{folder} cannot become a row: {wrong}")
    return row


def read_row(path: Path) -> Row:
    """Read the file of a row.

    Raises:
        BadFile: it is not a row, or too large to be one.
    """
    try:
        if not path.is_file():
            raise BadFile(f"{path} is not a file.")
        if path.stat().st_size > LARGEST:
            raise BadFile(f"{path} is larger than {LARGEST} bytes; a row has a few kilobytes.")
        table = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(table, dict) or table.get("format") != FORMAT:
            raise BadFile(f"{path} is not a row of format {FORMAT}.")
        json.dumps(table, ensure_ascii=False).encode()  # a ValueError if no page can show it
        return from_mapping(Row, table, str(path))
    except BadFile:
        raise
    except (OSError, ValueError, TypeError, RecursionError, InputError) as error:
        told = " ".join(str(error).split())[:200]
        raise BadFile(f"{path} cannot be read ({told}).") from None


def _default_config(run: RunConfig) -> TaskConfig:
    """Return the env that a row must have; that of a hierarchical policy differs."""
    env = TaskConfig(run.task)
    if run.termination is None:
        return env
    return replace(env, max_steps=MAX_STEPS, advance=advance_of(run.termination))


def problem(row: Row) -> str:
    """Return why a row is not accepted, as a sentence; "" if it is."""
    if row.sealed().digest != row.digest:
        return "its digest does not match its content; it was changed after it was made."
    env = row.run.env
    default = _default_config(row.run)
    shift = row.run.shift
    if shift is None:
        wanted = default
    elif (shift.axis, shift.strength) == (ALL, HALF):
        wanted = shifted_config(default, AXES[ALL], HALF)
    else:
        return f"it is shifted along {shift.axis} by {shift.strength:g}; only {ALL} by {HALF} is."
    if env != wanted:
        table = to_mapping(env)
        other = to_mapping(wanted)
        names = [name for name, value in table.items() if value != other[name]]
        return f"its env differs from the task's in {', '.join(names)}."
    if row.run.upset:
        return "its episodes were upset on purpose (upset)."
    if row.run.is_hierarchical and row.run.task != SUTURE:
        return f"it is a hierarchical policy of {row.run.task}, which is one subtask."
    if row.run.expert_swap is not None:
        return f"the expert acts in its {row.run.expert_swap} (expert_swap)."
    present = build_scene(env.scene).hash
    if row.scene_hash != present:
        return f"its scene {row.scene_hash[:12]} is not the present one, {present[:12]}."
    count = len(row.seeds)
    if len(row.successes) != count or len(row.steps) != count:
        return f"it has {count} starts, {len(row.successes)} outcomes and {len(row.steps)} lengths."
    if count < FEWEST or row.seeds != tuple(range(TEST_SEED, TEST_SEED + count)):
        return f"its starts are not {FEWEST} or more in a row from {TEST_SEED} on."
    if row.run.starts is not None and row.run.starts.seeds != range(TEST_SEED, TEST_SEED + count):
        return "its run names other starts than its outcomes are of."
    if not all(0 < steps <= env.max_steps for steps in row.steps):
        return f"an episode has no steps, or more than the task's {env.max_steps}."
    return ""


def write_leaderboard(folder: Path, out: Path) -> Board:
    """Check every row below a folder and write the page.

    Args:
        folder: holds the rows' files, `*.json`, at any depth.
        out: the page to write.

    Raises:
        BadFile: there is no such folder.
    """
    if not folder.is_dir():
        raise BadFile(f"{folder} is not a folder; give one with the files of rows.")
    taken: dict[str, Row] = {}
    refused: dict[str, str] = {}
    for path in sorted(folder.rglob("*.json")):
        name = _printable(str(path.relative_to(folder)))
        try:
            row = read_row(path)
            wrong = problem(row)
        except InputError as error:
            refused[name] = _printable(str(error))
            continue
        if not wrong and row.digest in taken:
            wrong = "the same row is already there."
        if wrong:
            refused[name] = _printable(wrong)
        else:
            taken[row.digest] = row
    rows = tuple(taken.values())
    write_bytes(out, _page(rows, refused).encode())
    return Board(out, rows, refused)


def _printable(text: str) -> str:
    """Return a text in which bytes of a file's name that are not UTF-8 are escaped."""
    return text.encode("utf-8", "backslashreplace").decode()


def write_row(row: Row, out: Path) -> None:
    """Write the file of a row."""
    write_json(out, to_mapping(row))


def _page(rows: Sequence[Row], refused: dict[str, str]) -> str:
    """Return the page."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("surgicai_vision.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    tables = [
        {"task": task, "condition": condition, "rows": table}
        for task in task_names()
        for condition in (CLEAN, SHIFTED)
        if (table := _table([r for r in rows if (r.run.task, r.condition) == (task, condition)]))
    ]
    template = environment.get_template("leaderboard.html.j2")
    return template.render(tables=tables, refused=refused, fewest=FEWEST, first=TEST_SEED)


def _table(rows: Sequence[Row]) -> list[dict[str, JSON]]:
    """Return the lines of one task and condition, the best first."""
    ordered = sorted(
        rows, key=lambda row: (-sum(row.successes) / len(row.successes), row.entry.name, row.digest)
    )
    lines: list[dict[str, JSON]] = []
    for place, row in enumerate(ordered):
        wins = sum(row.successes)
        bounds = clopper_pearson(wins, len(row.successes))
        lines.append(
            {
                "name": row.entry.name,
                "by": row.entry.by,
                "link": row.entry.link,
                "policy": row.run.name,
                "count": f"{wins}/{len(row.successes)}",
                "rate": percentages.percent(wins / len(row.successes)),
                "interval": percentages.interval(bounds),
                "against_best": _against(row, ordered[0]) if place else "",
                "demonstrations": row.run.demonstrations,
                "minutes": row.entry.minutes,
                "hardware": row.entry.hardware,
                "note": row.entry.note,
                "told": _told(row.run),
                "command": row.command,
                "digest": row.digest[:12],
            }
        )
    return lines


def _told(run: RunConfig) -> str:
    """Return what a policy is told that no robot knows; "" if that is nothing."""
    state = ["sees the state with the goal"] if run.sees_goal else []
    ends = ["ends given by the simulator"] if run.termination == "privileged" else []
    return "; ".join(state + ends)


def _against(row: Row, best: Row) -> str:
    """Return the p-value of a row against the best one, on the starts both have."""
    shared = min(len(row.seeds), len(best.seeds))
    return f"{mcnemar(row.successes[:shared], best.successes[:shared]):.2g}"
