"""For planners of other people: F from plain numbers, scenes from metres, conformance.

`features.py` (numpy only, may be copied alone) is F; `builder.py` makes scenes from
Cartesian input; `conformance.py` writes what other implementations are held against.
The same in C++: `onboard/`. For users: docs/own_planner.md.
"""
