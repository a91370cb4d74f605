"""Tries what a safety team tries first: kills, signals, and what comes out of it."""
