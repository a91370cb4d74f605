"""The command `rcirl`: absl flags to one call, no mathematics.

`rcirl.py` has the list of all sub-commands. Each is a module: its docstring is its help
and begins with examples, `USUAL` names the flags that `--help` shows, `main` is the
call. `flags/` is what they share. The files of
`experiments/` run the same modules from a clone. A new command is a module here and its
line in `rcirl.py`.
"""
