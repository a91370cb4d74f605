"""Closed loop: cases, the world they run in, and what a drive was like.

`rollout.py` is the only file that scans over time and maps over cases; `rows.py` names
the drivers; `metrics.py` measures a drive.
"""
