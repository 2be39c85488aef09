"""Validate: check a dataset, and repair a broken one."""
