"""One drive as a page: what happened, when and why it failed."""
