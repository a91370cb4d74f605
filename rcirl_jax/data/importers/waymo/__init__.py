"""Waymo Open Motion (TFRecord): `reader`, `map` for lanes, `widths` of lanes."""
