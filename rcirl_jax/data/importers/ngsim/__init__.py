"""NGSIM trajectory tables: `reader`, and `map` for the lanes of each site."""

from rcirl_jax.data.importers.format import Format

FORMAT = Format(
    options={"long_bytes": 0, "table": {}},
    free=("sizes", "table"),
)
