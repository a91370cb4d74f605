"""NGSIM trajectory tables: `reader`."""

from rcirl_jax.data.formats.format import Format, of_columns

FORMAT = Format(
    columns=of_columns("vehicle_id frame_id local_y v_vel lane_id"),
    told_by="reader",
    is_cut=True,
    options={"long_bytes": 0, "table": {}},
    free=("sizes", "table"),
)
