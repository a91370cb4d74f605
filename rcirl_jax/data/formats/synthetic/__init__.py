"""Simulated traffic as a log of its own: `reader`."""
