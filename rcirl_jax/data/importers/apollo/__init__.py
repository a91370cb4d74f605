"""Apollo cyber records: `records` is the file, `messages` and `obstacles` its content.

A new channel or message field is read in `messages`; `reader` makes recordings of it.
"""
