"""CommonRoad scenarios (Althoff 2017) and its reactive planner (Werling 2010).

`simulator.py` is our side; `worker.py` runs in an environment of its own, which has
`commonroad-reactive-planner` and, of this package, needs numpy and msgpack only:
commonroad-io asks for a protobuf that is older than ours. `cost.py` is a reward as the
cost function of the reactive planner.
"""
