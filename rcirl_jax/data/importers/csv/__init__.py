"""Tables as people have them: `reader` for tracks, `map` for lane files beside them."""
