"""The fields that are read of L5Kit's road_network.proto (package pb.lyft.maps)."""

from rcirl_jax.data.readers.protobuf import parser, table_of

# traffic controls that are faces of one colour: round, arrows, U-turn, flashing
COLOURS = {
    **dict.fromkeys((11, 30, 32, 38, 41, 44, 10), "red"),
    **dict.fromkeys((12, 36, 37, 39, 42, 45, 9), "yellow"),
    **dict.fromkeys((13, 31, 33, 40, 43, 46), "green"),
}
FACES = ", ".join(f"face_{number} {number} Nothing" for number in COLOURS)
SCHEMA = f"""
MapFragment: elements 2 MapElement*
MapElement: id 1 GlobalId, element 2 Element
GlobalId: id 1 string
Element: segment 1 Segment, lane 3 Lane, control 4 Control
Segment: limit 9 float, limit_backward 10 float
Lane: parent 1 GlobalId, frame 2 GeoFrame, left 3 Bound, right 4 Bound,\
 ahead 5 GlobalId*, beside_left 6 GlobalId, beside_right 7 GlobalId,\
 controls 8 GlobalId*, access 11 Access, direction 12 int64
GeoFrame: origin 1 GeoPoint, bearing 2 float
GeoPoint: latitude 1 sfixed32, longitude 2 sfixed32
Bound: x 1 sint32*, y 2 sint32*, z 3 sint32*
Access: type 1 int64
Control: stop_sign 7 Nothing, light 29 Light, {FACES}
Light: faces 3 GlobalId*
Nothing:
"""

read_message = parser(table_of(SCHEMA))
