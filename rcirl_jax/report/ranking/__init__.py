"""Pictures of ranking results: intervals, frames, sweeps."""
