"""Held-out scenes ranked: distances, metrics, table.

`evaluate` ties `score` (arrays on a device), `metrics` and `report` together; a learner
by name is a row of `learners`.
"""
