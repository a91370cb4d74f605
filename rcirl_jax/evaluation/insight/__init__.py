"""Insight into a reward: what it has learned, and from which features.

Shares of features, and the paper's background shift; each file answers one question
and nothing here decides anything.
"""
