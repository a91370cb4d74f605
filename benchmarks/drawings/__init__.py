"""The drawings of `benchmarks.pictures`: ideas, drives, recorded scenes, numbers."""
