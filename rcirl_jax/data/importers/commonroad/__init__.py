"""CommonRoad XML scenarios: `reader`, `map`, `signs` by country, `extras`."""
