"""The fields that are read of L5Kit's road_network.proto (package pb.lyft.maps)."""

from rcirl_jax.data.readers.protobuf import Field, parser

# traffic controls that are faces of one colour: round, arrows, U-turn, flashing
COLOURS = {
    **dict.fromkeys((11, 30, 32, 38, 41, 44, 10), "red"),
    **dict.fromkeys((12, 36, 37, 39, 42, 45, 9), "yellow"),
    **dict.fromkeys((13, 31, 33, 40, 43, 46), "green"),
}
TYPES = {
    "MapFragment": {"elements": Field("MapElement", 2, repeated=True)},
    "MapElement": {"id": Field("GlobalId", 1), "element": Field("Element", 2)},
    "GlobalId": {"id": Field("string", 1)},
    "Element": {
        "segment": Field("Segment", 1),
        "lane": Field("Lane", 3),
        "control": Field("Control", 4),
    },
    "Segment": {"limit": Field("float", 9), "limit_backward": Field("float", 10)},
    "Lane": {
        "parent": Field("GlobalId", 1),
        "frame": Field("GeoFrame", 2),
        "left": Field("Bound", 3),
        "right": Field("Bound", 4),
        "ahead": Field("GlobalId", 5, repeated=True),
        "beside_left": Field("GlobalId", 6),
        "beside_right": Field("GlobalId", 7),
        "controls": Field("GlobalId", 8, repeated=True),
        "access": Field("Access", 11),
        "direction": Field("int64", 12),
    },
    "GeoFrame": {"origin": Field("GeoPoint", 1), "bearing": Field("float", 2)},
    "GeoPoint": {"latitude": Field("sfixed32", 1), "longitude": Field("sfixed32", 2)},
    "Bound": {
        "x": Field("sint32", 1, repeated=True),
        "y": Field("sint32", 2, repeated=True),
        "z": Field("sint32", 3, repeated=True),
    },
    "Access": {"type": Field("int64", 1)},
    "Control": {
        "stop_sign": Field("Nothing", 7),
        "light": Field("Light", 29),
        **{f"face_{number}": Field("Nothing", number) for number in COLOURS},
    },
    "Light": {"faces": Field("GlobalId", 3, repeated=True)},
    "Nothing": {},
}

read_message = parser(TYPES)
