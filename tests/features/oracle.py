"""F again in plain float64 Python loops, written from the definitions."""

import numpy as np

from rcirl_jax.units import STATION_STEP_M, TIMES_S

T = TIMES_S.size
BUFFER, NUDGE = 0.2, 3.0


def interpolate(table, s):
    grid = np.arange(len(table)) * STATION_STEP_M
    return float(np.interp(s, grid, table))


def curvature(scene, s, l, dl, ddl):
    kappa_table = np.asarray(scene.path.kappa, np.float64)
    slope = np.gradient(kappa_table, STATION_STEP_M)
    k, dk = interpolate(kappa_table, s), interpolate(slope, s)
    shrink = max(1.0 - k * l, 0.1)
    angle = np.arctan(dl / shrink)
    inner = (ddl + (dk * l + k * dl) * np.tan(angle)) * np.cos(angle) ** 2 / shrink
    return (inner + k) * np.cos(angle) / shrink


def point(scene, trajectory, i):
    """All named features at time i, by loops over obstacles."""
    x = {
        k: np.asarray(getattr(trajectory, k), np.float64)
        for k in ("s", "v", "a", "j", "l", "dl", "ddl")
    }
    ob, ego = scene.obstacles, scene.ego
    half, half_w = float(ego.length) / 2, float(ego.width) / 2
    kappa = curvature(scene, x["s"][i], x["l"][i], x["dl"][i], x["ddl"][i])
    found = {
        name: []
        for name in ("follow", "overtake", "nudge", "front", "rear", "stop", "virtual")
    }
    distances, overrun = [], 0.0
    for n in range(len(ob.kind)):
        kind = int(ob.kind[n])
        if kind == 0 or not bool(ob.valid[n, i]):
            continue
        front_gap = float(ob.s_lower[n, i]) - (x["s"][i] + half)
        rear_gap = (x["s"][i] - half) - float(ob.s_upper[n, i])
        gap = max(front_gap, rear_gap)
        side = max(
            float(ob.l_lower[n, i]) - (x["l"][i] + half_w),
            (x["l"][i] - half_w) - float(ob.l_upper[n, i]),
        )
        speed = float(ob.speed[n, i]) - x["v"][i]
        if kind == 5:
            if front_gap >= 0:
                found["stop"].append((front_gap, speed, side))
            elif i > 0 and bool(ob.valid[n, i - 1]):
                before = float(ob.s_lower[n, i - 1]) - (x["s"][i - 1] + half)
                if before >= 0:
                    overrun = max(overrun, -front_gap)
            elif i == 0:
                overrun = max(overrun, -front_gap)
        elif kind == 6:
            if front_gap >= 0:
                found["virtual"].append((front_gap, speed, side))
        else:
            if side > 0 or gap > 0:
                distances.append(np.hypot(max(gap, 0), max(side, 0)))
            else:
                distances.append(max(gap, side))
            if side < BUFFER:
                if front_gap >= 0:
                    found["follow"].append((front_gap, speed, side))
                elif rear_gap >= 0:
                    found["overtake"].append((rear_gap, speed, side))
            elif side < NUDGE:
                name = "front" if front_gap >= 0 else "rear" if rear_gap >= 0 else None
                found[name or "nudge"].append((max(gap, 0.0), speed, side))
    closest = min(distances, default=1e6)
    if overrun > 0:
        closest = min(closest, -overrun)
    collision = float(np.clip(closest, -10.0, 100.0))

    def best(name, cap, by=0):
        rows = [row for row in found[name] if row[by] < cap]
        if not rows:
            return cap, 0.0
        low = min(row[by] for row in rows)
        return low, min(row[1] for row in rows if row[by] == low)

    out = {
        "l": x["l"][i],
        "dl": x["dl"][i],
        "ddl": x["ddl"][i],
        "curvature": kappa,
        "station": x["s"][i] - float(ego.s),
        "time": 8.0 * i / 17,
        "velocity": x["v"][i],
        "speed_limit": interpolate(np.asarray(scene.path.speed_limit), x["s"][i]),
        "acceleration": x["a"][i],
        "jerk": x["j"][i],
        "lateral_acceleration": x["v"][i] ** 2 * kappa,
        "collision_distance": collision,
        "collision": float(collision < 0),
        "nudge_distance": best("nudge", 60.0)[0],
    }
    for name, column, cap in (
        ("follow", "follow", 100.0),
        ("overtake", "overtake", 100.0),
        ("stop", "stop", 60.0),
        ("virtual", "virtual", 60.0),
        ("front", "sidepass_front", 100.0),
        ("rear", "sidepass_rear", 100.0),
    ):
        out[f"{column}_distance"], out[f"{column}_speed"] = best(name, cap)
    out["nudge_lateral"], out["nudge_speed"] = best("nudge", 10.0, by=2)
    return out


def table_slope(table, points):
    last = len(table) - 1
    return np.array(
        [
            (table[min(i + points, last)] - table[max(i - points, 0)])
            / (2.0 * points * STATION_STEP_M)
            for i in range(len(table))
        ]
    )


def motion(scene, s, l, mode):
    """Leaves of the Trajectory through float64 stations (and offsets) [T], by loops.

    `speed` takes the offsets of the scene's path, `path_speed` those given.
    """
    dt, ego = 8.0 / 17, scene.ego
    last = int(np.asarray(scene.time_valid).sum()) - 1
    v, a = [float(ego.v)], [float(ego.a)]
    for i in range(1, T):
        ends = i >= last
        a.append(a[-1] if ends else (s[i + 1] - 2 * s[i] + s[i - 1]) / dt**2)
        if ends:
            v.append((s[i] - s[i - 1]) / dt + 0.5 * a[-1] * dt)
        else:
            v.append((s[i + 1] - s[i - 1]) / (2 * dt))
    j = [(a[i] - a[i - 1]) / dt for i in range(1, T)]
    out = {"s": s, "v": v, "a": a, "j": [j[0], *j]}
    if mode == "speed":
        offset = np.asarray(scene.path.l, np.float64)
        slope = table_slope(offset, 3)
        tables = {"l": offset, "dl": slope, "ddl": table_slope(slope, 3)}
        out |= {n: [interpolate(x, at) for at in s] for n, x in tables.items()}
    else:
        dl = [float(ego.dl), *by_station(s, l)[1:]]
        out |= {"l": l, "dl": dl, "ddl": by_station(s, dl)}
    out["dl"][0], out["ddl"][0] = float(ego.dl), float(ego.ddl)
    return {name: np.asarray(values, np.float64) for name, values in out.items()}


def by_station(s, x):
    """dx/ds over the neighbouring times; 0 where the car moves less than a metre."""
    found = []
    for i in range(T):
        low, high = max(i - 1, 0), min(i + 1, T - 1)
        advance = s[high] - s[low]
        found.append((x[high] - x[low]) / advance if advance > 1.0 else 0.0)
    return found
