"""CommonRoad XML scenarios: `reader`, and `map` for lanes and signs."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(names=("*.xml",), is_small=True)
