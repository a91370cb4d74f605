"""INTERACTION: `reader` for tracks; its maps are Lanelet2 (`importers.lanelet2`)."""

from rcirl_jax.data.formats.format import Format, of_columns

FORMAT = Format(
    columns=of_columns("track_id timestamp_ms agent_type"),
    is_small=True,
    options={"map": "maps", "table": {}},
    free=("table",),
)
