"""Tables, suites, the gate, labels: how good a reward is, with honest intervals.

`statistics.py` has intervals over clusters, `exact.py` tests of counts.
"""
