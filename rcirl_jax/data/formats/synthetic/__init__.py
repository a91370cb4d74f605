"""Simulated traffic as a log of its own: `reader`."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(names=("*.toml",))
