"""Car-following pairs cut from NGSIM: `reader`."""

from rcirl_jax.data.importers.format import Format

FORMAT = Format(
    options={"table": {}},
    free=("table",),
)
