"""OpenACC platoon recordings (CSV): `reader`."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(told_by="reader", is_small=True, free=("sizes",))
