"""Executor: jobs by registered name, results in a store, the same command again is the resume.

A job is a registered function called as `function(folder, **arguments)`; it writes its result into
`folder`, which is empty when it starts. The folder is committed to the store by one rename under
the job's key, the sha256 over its name, its JSON arguments, the hashes of its inputs and the
versions of the code it runs. The store is the truth and the processes are not: what is there is
never computed again, whatever killed the run before. Results do not depend on the number of
workers.

    jobs = [Job("render-episode", {"demo": "…", "views": ["front"]}, inputs=(sha256,), weight=120)]
    folders = run(jobs, Path("out.work"), workers=2, progress=lambda done, total, unit: None)

The engine is `local` (spawned processes; `workers=0` runs in this one) or `ray_engine` (Ray Core,
an extra).
"""

from surgicai_vision.core.executor.jobs import JOBS, Job, JobKind
from surgicai_vision.core.executor.store import (
    ENGINES,
    LOCAL,
    Ended,
    Engine,
    Progress,
    building,
    claim,
    run,
    work_folder,
)

__all__ = [
    "ENGINES",
    "JOBS",
    "LOCAL",
    "Ended",
    "Engine",
    "Job",
    "JobKind",
    "Progress",
    "building",
    "claim",
    "run",
    "work_folder",
]
