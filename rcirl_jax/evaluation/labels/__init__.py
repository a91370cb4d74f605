"""Automatic labels held against truth, and written signals against drivers.

The truth of labels is what simulated drivers did; a new label gets its truth in
`made_traffic`.
"""
