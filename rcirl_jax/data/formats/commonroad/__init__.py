"""CommonRoad XML scenarios: `reader`, `map`, `signs` by country, `extras`."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(
    names=("*.xml",),
    is_small=True,
)
