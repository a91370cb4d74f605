"""Lyft Level 5 (zarr): `reader`, `map` for lanes, `scenes` for the tables."""
