"""Logs -> recordings -> scenes -> a dataset on disk.

`importers` yields a `Recording` per log, `scenes` cuts demonstrations from it, `store`
keeps them; `importing.py` runs this over many logs, piece by piece (`parts`, `cut`).
"""
