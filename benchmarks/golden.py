"""Compare the expert and the sweep `smoke` with the rows stored in tests/golden, number for number.

    python benchmarks/golden.py                  # both; 100 starts per subtask, about six minutes
    python benchmarks/golden.py --only expert
    python benchmarks/golden.py --write          # store the current rows, after a change of scene

The stored rows are those of version 0.1, made on a two-core Xeon. Physics gives the same bits on
the same machine; on another one the last digits may differ, which `--tolerance` allows for.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import pandas as pd
from common import emit

from surgicai_vision.commands.main import main as surgicai_vision
from surgicai_vision.core import names

FOLDER = Path(__file__).resolve().parent.parent / "tests" / "golden"
EPISODES = 100
MEASURED = (
    "success",
    "steps",
    "trajectory_length_mm",
    "d_trans_mm",
    "d_angle_deg",
    "contact",
    "error",
    "failure",
    "stages",
    "entry_mm",
    "exit_mm",
    "slip_mm",
    "slip_deg",
    "tissue_force_n",
    "bite_depth_mm",
    "bite_length_mm",
    "entry_deg",
    "exit_deg",
    "tissue_impulse_ns",
    "tears",
    "thread_mm",
    "paper_success",
)
"""Columns of an episode that a refactoring must not change."""


def expert_rows(folder: Path) -> pd.DataFrame:
    """Evaluate the expert on every subtask and return the rows of all episodes."""
    tables = []
    for task in names.SUBTASKS:
        out = folder / task
        starts = ["--episodes", str(EPISODES), "--seed", str(names.TEST_SEED)]
        _run("evaluate", "expert", "--task", task, *starts, "--out", str(out))
        tables.append(pd.read_parquet(out / "episodes.parquet"))
    return pd.concat(tables, ignore_index=True)[["task", "seed", *MEASURED]]


def smoke_rows(folder: Path) -> pd.DataFrame:
    """Run the sweep `smoke` from scratch and return the rows of all its runs."""
    _run("sweep", "smoke", "--out", str(folder / "smoke"))
    table = pd.read_parquet(folder / "smoke" / "episodes.parquet")
    keys = ["encoder", "view", "seed"]
    return table[[*keys[:2], "task", "seed", *MEASURED]].sort_values(keys, ignore_index=True)


SUITES: Mapping[str, Callable[[Path], pd.DataFrame]] = MappingProxyType(
    {"expert": expert_rows, "smoke": smoke_rows}
)


def differences(found: pd.DataFrame, stored: pd.DataFrame, tolerance: float) -> int:
    """Return in how many rows `found` differs from `stored`."""
    if len(found) != len(stored):
        return max(len(found), len(stored))
    differs = pd.Series(False, index=found.index)
    for column in stored.columns:
        if stored[column].dtype == float:
            gap = (found[column].astype(float) - stored[column]).abs()
            same = (gap <= tolerance) | (found[column].isna() & stored[column].isna())
        else:
            same = found[column].fillna("") == stored[column].fillna("")
        differs |= ~same
    return int(differs.sum())


def _run(*arguments: str) -> None:
    if surgicai_vision(list(arguments)) != 0:
        raise SystemExit(f"surgicai-vision {' '.join(arguments)} failed")


def main() -> int:
    """Compare or store; print one JSON line; return 1 if a row differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=tuple(SUITES))
    parser.add_argument(
        "--tolerance", type=float, default=0.0, help="largest allowed difference of a number"
    )
    parser.add_argument("--write", action="store_true", help="store the rows in tests/golden")
    chosen = parser.parse_args()
    counts = {}
    for name in [chosen.only] if chosen.only else SUITES:
        with tempfile.TemporaryDirectory() as folder:
            found = SUITES[name](Path(folder))
        path = FOLDER / f"{name}.parquet"
        if chosen.write:
            found.to_parquet(path, index=False)
        wrong = differences(found, pd.read_parquet(path), chosen.tolerance)
        counts[name] = {"rows": len(found), "different": wrong}
    emit("golden", counts)
    return int(any(row["different"] for row in counts.values()))


if __name__ == "__main__":
    sys.exit(main())
