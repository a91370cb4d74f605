"""TOML families -> cases: parameters drawn, expressions, tables.

A scenario family is a file in data_specs/scenarios; what a family can say is decided
in `families`.
"""
