"""The functions of the public API that are not simply those of a room below.

`import rcirl_jax` shows all of them (docs/api.md). A function here takes what a user
has, paths and settings by their names, and calls the rooms as the commands do. What is
wrong is answered by an `InputError`, one line: file, field, value, what was expected.
"""
