"""Comparisons: learners with humans, labels and verdicts with the truth."""
