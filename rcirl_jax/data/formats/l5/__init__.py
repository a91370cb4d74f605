"""Lyft Level 5 (zarr): `reader`, `map` for lanes, `scenes` for the tables."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(
    names=("*.zarr",),
)
