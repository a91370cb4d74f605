"""The tuning loop: logs -> reward -> closed loop -> verdict -> report.

`loop.py` runs the stages of one run folder; `recipes.py` reads the TOML that decides a
run; `anchoring.py` and `rehearsal.py` make the anchor and the rehearsed drives.
What a stage does may change here; how it is done lives in the rooms below.
"""
