"""How good a reward is, with honest intervals: ranking, closed loop, gate, baselines.

`statistics.py` has intervals over clusters and tests of counts, `attribution.py` why
one trajectory is valued above another.
"""
