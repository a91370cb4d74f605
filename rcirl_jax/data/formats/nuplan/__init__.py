"""nuPlan logs (SQLite): `reader`, and `map` for its GeoPackage maps."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(names=("*.db",), shard_bytes=2**28)
