"""What a reward has learned and what the data support.

Shares of features, Laplace intervals, identifiability, known truth, background; each
file answers one question and nothing here decides anything.
"""
