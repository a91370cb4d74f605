"""Held-out scenes ranked: distances, metrics, table.

`evaluate` ties `score` (arrays on a device), `metrics` and `table` together; a learner
by name is a row of `learners`.
"""
