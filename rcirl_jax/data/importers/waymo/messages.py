"""The fields that are read of scenario.proto and map.proto.

Whole numbers and enums are all int64: as coded they are alike, and numbers that no
release knows are seen rather than dropped.
"""

from rcirl_jax.data.readers.protobuf import Field, parser

TYPES = {
    "Scenario": {
        "timestamps_seconds": Field("double", 1, repeated=True),
        "tracks": Field("Track", 2, repeated=True),
        "scenario_id": Field("string", 5),
        "sdc_track_index": Field("int64", 6, default="-1"),
        "dynamic_map_states": Field("DynamicMapState", 7, repeated=True),
        "map_features": Field("MapFeature", 8, repeated=True),
    },
    "Track": {
        "id": Field("int64", 1),
        "object_type": Field("int64", 2),
        "states": Field("ObjectState", 3, repeated=True),
    },
    "ObjectState": {
        "center_x": Field("double", 2),
        "center_y": Field("double", 3),
        "length": Field("float", 5),
        "width": Field("float", 6),
        "heading": Field("float", 8),
        "velocity_x": Field("float", 9),
        "velocity_y": Field("float", 10),
        "valid": Field("bool", 11),
    },
    "DynamicMapState": {"lane_states": Field("LaneState", 1, repeated=True)},
    "LaneState": {
        "lane": Field("int64", 1),
        "state": Field("int64", 2),
        "stop_point": Field("MapPoint", 3),
    },
    "MapFeature": {
        "id": Field("int64", 1),
        "lane": Field("Lane", 3),
        "road_line": Field("Line", 4),
        "road_edge": Field("Line", 5),
        "stop_sign": Field("StopSign", 7),
    },
    "MapPoint": {"x": Field("double", 1), "y": Field("double", 2)},
    "Lane": {
        "speed_limit_mph": Field("double", 1),
        "type": Field("int64", 2),
        "polyline": Field("MapPoint", 8, repeated=True),
        "entry_lanes": Field("int64", 9, repeated=True),
        "exit_lanes": Field("int64", 10, repeated=True),
        "left_neighbors": Field("Neighbor", 11, repeated=True),
        "right_neighbors": Field("Neighbor", 12, repeated=True),
        "left_boundaries": Field("Boundary", 13, repeated=True),
        "right_boundaries": Field("Boundary", 14, repeated=True),
    },
    "Neighbor": {
        "feature_id": Field("int64", 1),
        "self_start_index": Field("int64", 2),
        "self_end_index": Field("int64", 3),
    },
    "Boundary": {
        "lane_start_index": Field("int64", 1),
        "lane_end_index": Field("int64", 2),
        "boundary_feature_id": Field("int64", 3),
    },
    "Line": {"polyline": Field("MapPoint", 2, repeated=True)},
    "StopSign": {
        "lane": Field("int64", 1, repeated=True),
        "position": Field("MapPoint", 2),
    },
}

read_message = parser(TYPES)
