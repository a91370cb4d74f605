"""A planner as a program: IDM behind the nearest body in the ego's corridor.

    rcirl simulate --planner="python3 onboard/example/planner_program.py" --output=DIR

It needs nothing but Python. Lines of JSON come in and go out; docs/own_process.md.
"""

import json
import sys


def acceleration(ego: dict, path: dict, obstacles: list[dict]) -> float:
    """m/s^2 of the Intelligent Driver Model."""
    front, nearest = ego["s"] + 0.5 * ego["length"], None
    for body in obstacles:
        right, left = body["l_lower"][0] - ego["l"], ego["l"] - body["l_upper"][0]
        in_way = max(right, left) < 0.5 * ego["width"] + 0.2
        if body["valid"][0] and in_way and body["s_upper"][0] > ego["s"]:
            gap = body["s_lower"][0] - front
            if nearest is None or gap < nearest[0]:
                nearest = gap, body["speed"][0]
    v = ego["v"]
    gap, speed = nearest or (1000.0, v)
    interaction = v * (v - speed) / (2.0 * (1.4 * 2.0) ** 0.5)
    wanted = 2.0 + max(1.5 * v + interaction, 0.0)
    free = (v / max(path["speed_limit"][0], 0.1)) ** 4
    a = 1.4 * (1.0 - free - (wanted / max(gap, 0.1)) ** 2)
    return min(max(a, -8.0), 1.4)


def plan(ego: dict, path: dict, obstacles: list[dict]) -> dict[str, list[float]]:
    """Holds that acceleration until standing."""
    v, a = ego["v"], acceleration(ego, path, obstacles)
    until = [min(t, v / -min(a, -1e-6)) if a < 0.0 else t for t in times]
    s = [v * t + 0.5 * a * t * t for t in until]
    return {"s": s, "v": [v + a * t for t in until], "a": [a] * len(times)}


times = json.loads(sys.stdin.readline())["times"]
print(json.dumps({"protocol": 1, "name": "IDM in Python"}), flush=True)
for line in sys.stdin:
    print(json.dumps(plan(**json.loads(line)["scene"])), flush=True)
