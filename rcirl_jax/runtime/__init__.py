"""What every program needs: whole files, stages, processes, signals, settings.

Nothing here knows of driving. `atomic_files` writes whole files or none, `pipeline`
keeps what a run folder has done, `executors` runs pieces in processes or on Ray,
`signals` ends in order, `specs` and `settings` read TOML, `compiling` measures JAX,
`bars` says when it compiles.
"""
