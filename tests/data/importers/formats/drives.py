"""Motions that fixtures write: straight on or along an arc, at changing speed."""

import dataclasses

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Written

WAVE_RAD_S = 0.7  # rad/s, of a changing speed
# of drives that one car saw, on a clock of 10 Hz
DURATION_S = 8.0
GRID = 0.1 * np.arange(81)
GAP = (3.0, 5.0)  # s, in which 19 is hidden
SEEN = {"17": (2.0, 6.5)}  # s, others: the whole drive


def motion(t, speed, wave):
    """(station, speed) of v = speed + wave sin(0.7 t); all in m and s."""
    station = speed * t + wave / WAVE_RAD_S * (1.0 - np.cos(WAVE_RAD_S * t))
    return station, speed + wave * np.sin(WAVE_RAD_S * t)


def straight(t, start, heading, speed, *, wave=0.0, kind=Kind.VEHICLE, size=(4.5, 1.9)):
    """Along a heading [rad] from start [m] at t = 0, at a speed [m/s]."""
    station, speeds = motion(t, speed, wave)
    return Written(
        kind=kind,
        length=size[0],
        width=size[1],
        t=t,
        x=start[0] + station * np.cos(heading),
        y=start[1] + station * np.sin(heading),
        heading=np.full(t.shape, float(heading)),
        speed=speeds,
    )


def arc(t, start, heading, speed, radius, *, wave=0.0, size=(4.5, 1.9)):
    """Along a circle; radius [m] > 0 turns left, < 0 right."""
    station, speeds = motion(t, speed, wave)
    angle = heading + station / radius
    return Written(
        kind=Kind.VEHICLE,
        length=size[0],
        width=size[1],
        t=t,
        x=start[0] + radius * (np.sin(angle) - np.sin(heading)),
        y=start[1] - radius * (np.cos(angle) - np.cos(heading)),
        heading=(angle + np.pi) % (2.0 * np.pi) - np.pi,
        speed=speeds,
    )


def seen_by_a_car(t, ego):
    """Id -> road user of what one car's perception sees; `ego` is the car's size [m].

    A leader, one that turns left, two beside, a walker, a cyclist and a post.
    """
    walker = {"kind": Kind.PEDESTRIAN, "size": (0.6, 0.6)}
    cyclist = {"kind": Kind.CYCLIST, "size": (1.7, 0.6)}
    post = {"kind": Kind.STATIC, "size": (0.4, 0.4)}
    return {
        "ego": straight(t, (0.0, 0.0), 0.0, 8.0, size=ego),
        "12": straight(t, (25.0, 0.0), 0.0, 8.0),
        "15": arc(t, (60.0, 0.0), 0.0, 7.0, 25.0, size=(5.2, 2.0)),
        "17": straight(t, (-30.0, 3.5), 0.0, 11.0),
        "19": straight(t, (-10.0, 3.5), 0.0, 9.0, size=(11.0, 2.6)),
        "23": straight(t, (50.0, -6.0), np.pi / 2, 1.3, **walker),
        "27": straight(t, (0.0, -2.0), 0.0, 5.0, **cyclist),
        "31": straight(t, (40.0, -3.0), 0.0, 0.0, **post),
    }


def is_seen(name, t):
    """Whether a road user of `seen_by_a_car` is seen at a time [s]."""
    first, last = SEEN.get(name, (0.0, DURATION_S))
    return first <= t <= last and not (name == "19" and GAP[0] < t < GAP[1])


def perception_times():
    """Irregular, 0.08 to 0.12 s apart; the first and last fall on the clock."""
    t = GRID + 0.01 * np.sin(7.0 * np.arange(GRID.size))
    t[[0, -1]] = GRID[[0, -1]]
    for edge in (*GAP, *SEEN["17"]):
        t[np.argmin(np.abs(GRID - edge))] = edge
    return t.tolist()


def seen_on_clock(users, name_of=str):
    """Tracks of the road users at `GRID`, by the names that an importer gives."""
    found = {"ego": users["ego"]}
    for name, user in users.items():
        times = [t for t in perception_times() if is_seen(name, t)]
        if name == "19":
            found[f"{name_of(name)}#2"] = _on_clock(user, times, GAP[1])
            times = [t for t in times if t <= GAP[0]]
        if name != "ego":
            found[name_of(name)] = _on_clock(user, times, 0.0)
    return found


def _on_clock(user, times, begin):
    inside = [round(10.0 * t) for t in times if t >= begin]
    return samples(user, slice(min(inside), max(inside) + 1))


def samples(written, rows):
    """The road user at some of its samples."""
    series = ("t", "x", "y", "heading", "speed")
    return dataclasses.replace(
        written, **{name: getattr(written, name)[rows] for name in series}
    )
