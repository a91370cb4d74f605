"""Argoverse 2 motion forecasting: scenarios and their maps."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(names=("scenario_*.parquet",), is_small=True, free=("kinds", "sizes"))
