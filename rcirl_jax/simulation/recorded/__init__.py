"""Stored scenes -> cases: others as recorded, the ego driven by the planner."""
