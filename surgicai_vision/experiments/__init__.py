"""Experiments: runs, sweeps of runs, DAgger and the quickstart."""
