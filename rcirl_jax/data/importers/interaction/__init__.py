"""INTERACTION: `reader` for tracks; its maps are Lanelet2 (`importers.lanelet2`)."""
