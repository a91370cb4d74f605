"""Car-following pairs cut from NGSIM: `reader`."""

from rcirl_jax.data.formats.format import Format, of_columns

FORMAT = Format(
    columns=of_columns("x_follower x_leader leader_length"),
    is_small=True,
    options={"table": {}},
    free=("table",),
)
