"""Sweep: a grid of cells; each is encode (cached) → train → evaluate, and is done once, by jobs of
the executor.

`out` holds `sweep.json` (the grid), `data/<task>/` (demonstrations and dataset), `cells/<key>/`
with `policy/`, `evaluation/` and `cell.json`, `policies/<key>/` (what chains share), `references/`
(expert, replay), `episodes.parquet` (one row an episode), `probes.parquet` (where asked for) and
`run.json` for the report. The key is the digest of everything a cell is; `cell.json` names the job,
which counts code and versions too. So running again does only what is missing or was made by other
code; a cell that failed is tried again, one whose weights cannot be had is reported as not run,
with the reason. Finished jobs wait in `work/` until they are filed; nothing else is needed to go on
after a kill.
"""

from surgicai_vision.evaluation.storage import CELL_FILE, FAILED_FILE, GRID_FILE
from surgicai_vision.experiments.sweep.driver import EPISODES, run_sweep
from surgicai_vision.experiments.sweep.estimate import estimate
from surgicai_vision.experiments.sweep.grid import AXES, Grid
from surgicai_vision.experiments.sweep.plan import STATES, CellState, plan
from surgicai_vision.experiments.sweep.selection import Choice, read_choice

__all__ = [
    "AXES",
    "CELL_FILE",
    "EPISODES",
    "FAILED_FILE",
    "GRID_FILE",
    "STATES",
    "CellState",
    "Choice",
    "Grid",
    "estimate",
    "plan",
    "read_choice",
    "run_sweep",
]
