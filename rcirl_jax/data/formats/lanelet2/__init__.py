"""Lanelet2 maps, shared by formats: `map` reads OSM XML, `rules` what it means."""
