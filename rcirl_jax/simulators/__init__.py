"""Drives in simulators that others wrote: does the reward drive well elsewhere too?

`simulators.py` is the interface and the registry by name, a file a simulator gives it.
`drive.py` has who drives and the loop, `measures.py` numbers of a drive, `table.py` the
table and its files. A simulator's package is imported in its own file only, which only
`simulators.open_simulator` loads. To add one: a file with a class as `Simulator` says,
and its line in `SIMULATORS`.
"""
