"""Tools of every program: whole files, stages, processes, signals, settings.

Nothing here knows of driving. `atomic_files` writes whole files or none, `pipeline`
keeps what a run folder has done, `executors` runs pieces in processes or on Ray,
`answering` asks a program with a limit of time, `signals` ends in order, `specs` and
`checked` read TOML and JSON, `compiling` measures JAX and says when it compiles.
"""
