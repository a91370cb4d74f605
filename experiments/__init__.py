"""Experiment files: absl flags -> one call. Run with `python -m experiments.X`."""
