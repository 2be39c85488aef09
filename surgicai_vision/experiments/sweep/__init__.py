"""Sweep: the runs of a grid or of a plan, done once each by jobs of the executor.

A run is encode (cached) → train → evaluate, or the evaluation of policies that runs share.

`out` holds `sweep.json` (the grid, or the plan), `data/<name>/` (demonstrations and dataset),
`runs/<key>/` with `policy/`, `evaluation/` and `result.json`, `policies/<key>/` (policies that runs
share), `references/` (expert, replay), `episodes.parquet` (one row per episode), `probes.parquet`
(if requested) and `run.json` for the report. The key is the digest of the `RunConfig`;
`result.json` names the job, which depends on code and versions too. So running again does only what
is missing or was made by other code. A run that failed is tried again; one whose weights are not
available is reported as not run, with the reason. Finished jobs wait in `work/` until they are
filed, and a training that was killed continues in `training/`; nothing else is needed to continue
after a kill.
"""
