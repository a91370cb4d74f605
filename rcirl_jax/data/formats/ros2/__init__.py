"""ROS 2 bags: `bags` finds the files, `mcap_file` and `sqlite_file` read messages.

`messages` chooses topics, `readings` and `objects` turn messages into rows of numbers,
`held` keeps the rows that windows still need, `lights` and `lanes` are what stands
beside the road. A new type of message is a function in `readings.TYPES` or
`objects.TYPES`; `reader` makes recordings.
"""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(
    names=("*.mcap", "*.db3"),
    shard_bytes=2**28,
    options={"lanes": {"file": "lanes.csv"}},
    free=("lights", "kinds"),
    checked=("pattern", "topics", "lanes"),
)
