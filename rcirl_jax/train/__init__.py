"""Training: state, step, parallel, checkpoint, loop."""
