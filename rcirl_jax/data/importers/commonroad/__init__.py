"""CommonRoad XML scenarios: `reader`, `map` for lanelets, `extras` for signals."""
