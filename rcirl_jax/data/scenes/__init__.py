"""One recording -> demonstrations: which moments count, what surrounds them, labels.

`collect.py` is the sequence; filters (`filters.py`, why a moment is dropped), labels,
lines and lights, lanes and motion are one file each and may change apart.
"""
