"""Waymo Open Motion (TFRecord): `reader`, `map` for lanes and signals."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(names=("*.tfrecord*",), shard_bytes=2**30, free=("kinds",))
