"""The tuning loop: logs -> reward -> closed loop -> verdict -> report.

`loop.py` is the order of the stages, `run.py` the folder of one run, `config.py` what
decides it. The stages: `demonstrations.py` (import, rehearse), `rewards.py` (train),
`evidence.py` (rank, simulate, gate), `report.py`. `progress.py` says how long it will
go on. `recipes.py` reads the TOML that decides a run; `prior_cost.py` and
`rehearsal.py` make the prior cost and rehearsed drives.
What a stage does may change here; how it is done lives in the rooms below.
"""
