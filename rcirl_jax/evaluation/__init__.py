"""Evaluation of rewards with 95 % intervals: ranking, closed loop, gate, baselines.

`statistics.py` has intervals over clusters and tests of counts, `attribution.py` why
one trajectory is valued above another.
"""
