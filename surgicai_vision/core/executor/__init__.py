"""Executor: jobs by registered name, results in a store; the same command again resumes.

A job is a registered function called as `function(folder, **arguments)`; it writes its result into
`folder`, which is empty when it starts. The folder is committed to the store by one rename under
the job's key, the sha256 over its name, its JSON arguments, the hashes of its inputs and the
versions of the code it runs. Only the store counts, not the processes: a result in it is never
computed again, whatever killed an earlier run. Results do not depend on the number of workers.

    jobs = [Job("render-episode", {"demo": "…", "views": ["front"]}, inputs=(sha256,), weight=120)]
    folders = run(jobs, Path("out.work"), RunContext(workers=2))

An engine runs the jobs: processes of this machine, Ray or Slurm (extras), or an engine of another
distribution.
"""

from surgicai_vision.core.executor.context import RunContext
from surgicai_vision.core.executor.engine import Ending, Engine
from surgicai_vision.core.executor.engines import ENGINES, open_engine, register_engine
from surgicai_vision.core.executor.jobs import JOBS, Job, JobKind, Task, job, perform, register_job
from surgicai_vision.core.executor.local import LOCAL, LocalEngine
from surgicai_vision.core.executor.store import Ended, building, claim, run, work_folder

__all__ = [
    "ENGINES",
    "JOBS",
    "LOCAL",
    "Ended",
    "Ending",
    "Engine",
    "Job",
    "JobKind",
    "LocalEngine",
    "RunContext",
    "Task",
    "building",
    "claim",
    "job",
    "open_engine",
    "perform",
    "register_engine",
    "register_job",
    "run",
    "work_folder",
]
