"""Argoverse 2 motion forecasting: `reader` for scenarios, `map` for their lanes."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(
    names=("scenario_*.parquet",),
    is_small=True,
    free=("kinds", "sizes"),
)
