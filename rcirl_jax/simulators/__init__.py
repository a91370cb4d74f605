"""Drives in simulators that others wrote: does the reward drive well elsewhere too?

`simulators.py` is what a simulator has to give and the registry by name; a file or
folder a simulator gives it. `scenes.py` turns views into planning frames, `drivers.py`
has who drives, `drive.py` the loop, `measures.py` numbers of a drive, `table.py` the
table and its files. A simulator's package is imported in its own file only, which only
`simulators.open_simulator` loads. To add one: a file with a class as `Simulator` says,
and its line in `SIMULATORS`.
"""
