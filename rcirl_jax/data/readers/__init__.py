"""Readers that importers share: tables, XML, SQLite, protobuf, zarr, TFRecord."""
