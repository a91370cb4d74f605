"""Lyft Level 5 (zarr): `reader`, `map` for lanes and lights."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(names=("*.zarr",))
