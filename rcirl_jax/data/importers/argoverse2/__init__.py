"""Argoverse 2 motion forecasting: `reader` for scenarios, `map` for their lanes."""
