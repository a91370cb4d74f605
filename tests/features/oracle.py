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
