"""Suites driven and written down: `suite` drives, `summary` rates and compares.

Columns of the table are added in `summary`; `likeness` drives held-out recordings.
"""
