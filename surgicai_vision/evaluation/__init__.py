"""Evaluation: policies on held-out starts, counted from the measured state."""
