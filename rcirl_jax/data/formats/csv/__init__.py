"""Tables of a user's own: `reader`."""
