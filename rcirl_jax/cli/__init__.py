"""The command `rcirl`: absl flags to one call, no mathematics.

`rcirl.py` lists all sub-commands. Each is a module: its docstring is its help and
begins with examples, `USUAL` names the flags that `--help` shows, `main` is the call.
`flags.py` has the flags that several share, `running.py` the frame of every main: help,
one line on bad input, provenance. A new command is a module here and its line in
`rcirl.py`. The files of `experiments/` are programs of their own.
"""
