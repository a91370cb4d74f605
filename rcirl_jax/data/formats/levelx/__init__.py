"""levelXData (highD, inD, rounD, exiD, uniD): `reader` for tracks and lanes."""

from rcirl_jax.data.formats.format import Format, of_columns

FORMAT = Format(
    columns=of_columns("frame id xvelocity", "frame trackid xcenter"),
    is_small=True,
    options={"map": "maps", "partial": True, "table": {}},
    free=("sizes", "table"),
)
