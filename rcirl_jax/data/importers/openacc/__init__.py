"""OpenACC platoon recordings (CSV): `reader`."""

from rcirl_jax.data.importers.format import Format

FORMAT = Format(
    free=("sizes",),
)
