"""Recordings, scenes, labels, datasets."""
