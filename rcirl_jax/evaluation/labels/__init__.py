"""Automatic labels held against truth: made traffic, signals, stops, logs.

`cases` are scenes whose labels are known; a new label gets its case there.
"""
