"""Apollo cyber records: `records` is the file, `reader` makes recordings of it."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(
    names=("*.record", "*.record.*"), shard_bytes=2**28, checked=("pattern", "topics")
)
