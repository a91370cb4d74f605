"""nuPlan logs (SQLite): `reader`, and `map` for its GeoPackage maps."""
