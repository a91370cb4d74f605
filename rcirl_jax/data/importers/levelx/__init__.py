"""levelXData (highD, inD, rounD, exiD, uniD): `reader` for tracks, `map` for lanes."""
