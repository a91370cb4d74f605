"""What a reward has learned, and from what.

Shares of features, and the paper's background shift; each file answers one question
and nothing here decides anything.
"""
