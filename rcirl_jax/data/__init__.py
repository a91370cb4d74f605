"""Logs -> recordings -> scenes -> a dataset on disk.

`formats` yields a `Recording` per log (`recording.py` checks it), `scenes` cuts
demonstrations from it, `store` keeps them; `importing.py` runs this over many logs,
which `inputs.py` distributes file by file.
"""
