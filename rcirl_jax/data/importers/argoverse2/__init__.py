"""Argoverse 2 motion forecasting: `reader` for scenarios, `map` for their lanes."""

from rcirl_jax.data.importers.format import Format

FORMAT = Format(
    free=("kinds", "sizes"),
)
