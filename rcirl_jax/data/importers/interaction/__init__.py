"""INTERACTION: `reader` for tracks; its maps are Lanelet2 (`importers.lanelet2`)."""

from rcirl_jax.data.importers.format import Format

FORMAT = Format(
    options={"map": "maps", "table": {}},
    free=("table",),
)
