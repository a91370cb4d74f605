"""levelXData (highD, inD, rounD, exiD, uniD): `reader` for tracks, `map` for lanes."""

from rcirl_jax.data.importers.format import Format

FORMAT = Format(
    options={"map": "maps", "partial": True, "table": {}},
    free=("sizes", "table"),
)
