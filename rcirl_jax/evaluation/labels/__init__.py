"""Automatic labels held against truth: made traffic, signals, stops, logs.

The truth is what simulated drivers did; a new label gets its truth in `made_traffic`.
"""
