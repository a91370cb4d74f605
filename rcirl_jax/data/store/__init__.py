"""Demonstrations on disk: written once, read in any order, split and joined.

`dataset.py` is the format and its reader, `writer.py` writes it; `batches.py` decides
the order of rows in training and reads ahead. A change of what is stored needs a new
version of the format.
"""
