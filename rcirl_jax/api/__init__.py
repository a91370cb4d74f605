"""The functions of the public API that are not simply those of a package below.

`import rcirl_jax` shows all of them (docs/api.md). `scenes.py` has those of a scene and
its candidates, `runs.py` those from logs to a verdict. A function takes what a user
has, paths and settings by their names, and calls the packages as the commands do. What
is wrong is answered by an `InputError`, one line: argument or file, value, what was
expected.
"""
