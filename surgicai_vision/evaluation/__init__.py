"""Evaluation: run policies from held-out starts and judge them by the measured state."""
