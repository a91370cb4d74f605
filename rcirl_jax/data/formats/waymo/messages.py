"""The fields that are read of scenario.proto and map.proto.

Whole numbers and enums are all int64: as coded they are alike, and numbers that no
release knows are seen rather than dropped.
"""

from rcirl_jax.data.readers.protobuf import parser, table_of

SCHEMA = """
Scenario: timestamps_seconds 1 double*, tracks 2 Track*, scenario_id 5 string,\
 sdc_track_index 6 int64=-1, dynamic_map_states 7 DynamicMapState*,\
 map_features 8 MapFeature*
Track: id 1 int64, object_type 2 int64, states 3 ObjectState*
ObjectState: center_x 2 double, center_y 3 double, length 5 float, width 6 float,\
 heading 8 float, velocity_x 9 float, velocity_y 10 float, valid 11 bool
DynamicMapState: lane_states 1 LaneState*
LaneState: lane 1 int64, state 2 int64, stop_point 3 MapPoint
MapFeature: id 1 int64, lane 3 Lane, road_line 4 Line, road_edge 5 Line,\
 stop_sign 7 StopSign
MapPoint: x 1 double, y 2 double
Lane: speed_limit_mph 1 double, type 2 int64, polyline 8 MapPoint*,\
 entry_lanes 9 int64*, exit_lanes 10 int64*,\
 left_neighbors 11 Neighbor*, right_neighbors 12 Neighbor*,\
 left_boundaries 13 Boundary*, right_boundaries 14 Boundary*
Neighbor: feature_id 1 int64, self_start_index 2 int64, self_end_index 3 int64
Boundary: lane_start_index 1 int64, lane_end_index 2 int64, boundary_feature_id 3 int64
Line: polyline 2 MapPoint*
StopSign: lane 1 int64*, position 2 MapPoint
"""

read_message = parser(table_of(SCHEMA))
