"""Readers that importers share: tables, XML, SQLite, protobuf, zarr, TFRecord.

A reader turns bytes into arrays under limits of size and depth and knows nothing of
traffic. A file format that several importers need is added here.
"""
