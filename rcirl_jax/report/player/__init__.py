"""Cases driven again for the report, and the player that shows them."""
