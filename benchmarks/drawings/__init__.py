"""What `benchmarks.pictures` draws: ideas, drives, recorded scenes, numbers."""
