"""Tables of a user's own: `reader`, `columns`; `suggest` writes a TOML."""

from rcirl_jax.data.formats.format import Format

FORMAT = Format(
    is_cut=True,
    options={
        **{"reference_point": "centre", "heading_convention": "ccw_from_x"},
        **{"automated_values": ["yes"], "long_bytes": 0, "table": {}},
        **{"scale": {}, "offset": {}, "kinds": {"car": "vehicle"}},
        "lanes": [
            {
                **{"id": "1", "points": [[0.0, 0.0]], "width": 3.5, "speed_limit": 9.0},
                **{"left": "2", "right": "3", "successors": ["4"]},
            },
            {"file": "lanes.csv"},
        ],
        "missing": [
            {"time": [0.0, 8.0], "x": [0.0, 99.0], "y": [0.0, 0.0], "recording": "d"}
        ],
        "defaults": {"rate_hz": 10.0, "length": 4.5, "width": 1.8, "kind": "vehicle"},
    },
    free=("columns", "units", "scale", "offset", "kinds", "table"),
    checked=("pattern", "lanes", "missing"),
)
