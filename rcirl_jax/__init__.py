"""Rank-based conditional inverse reinforcement learning for motion planners."""

__version__ = "0.1.0"
