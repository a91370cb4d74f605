"""ROS 2 bags: `bag` finds and opens files, `messages` turns messages into rows.

`reader` makes recordings of the rows, with lanes and lights by `map`. A new type of
message is a function in `messages.TYPES`.
"""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(
    names=("*.mcap", "*.db3"),
    shard_bytes=2**28,
    options={"lanes": {"file": "lanes.csv"}},
    free=("lights", "kinds"),
    checked=("pattern", "topics", "lanes"),
)
