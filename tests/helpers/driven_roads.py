"""Roads that are known, and noisy drives on them: what an estimate is compared with."""

import dataclasses

import numpy as np

from rcirl_jax.types import Kind, Track


@dataclasses.dataclass
class Driven:
    """Tracks, the middle of each lane [m, 2] m, and (track, place) of changes."""

    tracks: list
    lanes: dict
    changes: list = dataclasses.field(default_factory=list)


def curve(s, kappa, start=(0.0, 0.0), heading=0.0):
    """Points [n, 2] m and headings [n] rad along a curvature kappa(s) 1/m."""
    h = heading + np.append(0.0, np.cumsum(0.5 * (kappa[1:] + kappa[:-1]) * np.diff(s)))
    middle = 0.5 * (h[1:] + h[:-1])
    steps = np.stack([np.cos(middle), np.sin(middle)], axis=1) * np.diff(s)[:, None]
    return np.array(start) + np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)]), h


def beside(points, heading, left):
    """Points moved to the left, m."""
    return points + np.stack([-np.sin(heading), np.cos(heading)], axis=1) * np.reshape(
        np.broadcast_to(left, heading.shape), (-1, 1)
    )


def dense(line):
    """A line of points a metre apart, ten times as many."""
    at = np.arange(0.0, len(line) - 1.0, 0.1)
    return np.stack([np.interp(at, np.arange(len(line)), x) for x in line.T], axis=1)


def ramp(s, begin, length):
    """0 before, 1 after, smooth between."""
    u = np.clip((s - begin) / length, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u * u)


def drive(rng, name, road, left_of, speed, start, *, rate=12.5, noise=0.15):
    """One car on a road (points, heading every metre), as a camera sees it.

    Args:
      rng: random numbers.
      name: of the track.
      road: points [n, 2] and headings [n], one a metre.
      left_of: stations [m] -> m to the left of the road's line.
      speed: m/s in the mean.
      start: s.
      rate: 1/s.
      noise: m, of each position.
    """
    points, heading = road
    count = int((len(points) - 1) / speed * rate)
    t = start + (np.arange(count) + rng.uniform(-0.1, 0.1, count)) / rate
    gone = t - start
    station = np.arange(len(points))
    s = np.clip(speed * gone + 3.0 * np.sin(0.1 * gone), 0.0, station[-1])
    sway = rng.uniform(0.0, 0.25) * np.sin(
        s / rng.uniform(60.0, 150.0) + rng.uniform(0.0, 6.0)
    )
    left = left_of(s) + rng.normal(0.0, 0.15) + sway
    h = np.interp(s, station, heading)
    x = np.interp(s, station, points[:, 0]) - left * np.sin(h)
    y = np.interp(s, station, points[:, 1]) + left * np.cos(h)
    return Track(
        id=name,
        kind=Kind.VEHICLE,
        length=4.5,
        width=1.9,
        t=t,
        x=x + rng.normal(0.0, noise, count),
        y=y + rng.normal(0.0, noise, count),
        heading=np.arctan2(np.sin(h), np.cos(h)),
        speed=np.full(count, speed),
    )


def motorway(seed=0, *, minutes=6.0, width=3.5):
    """Two lanes that bend to the right, between a slip road, an exit and a third lane.

    The slip road runs beside the right lane from 170 m and ends at 370 m. The exit
    leaves that lane at 620 m, and who takes it makes no step to the side. A third lane
    begins on the left at 450 m. `changes` are (track, place [2] m) over a lane's edge.

    Args:
      seed: of the traffic.
      minutes: of traffic.
      width: m of each lane.
    """
    rng, s = np.random.default_rng(seed), np.arange(901.0)
    kappa = -np.sin(np.clip((s - 50.0) / 800.0, 0.0, 1.0) * np.pi) / 450.0
    road = curve(s, kappa, (-20.0, 40.0), 1.1)
    slip = -width - 16.0 * (1.0 - ramp(s, -60.0, 230.0))
    exits = -(np.maximum(s - 620.0, 0.0) ** 2) / 1400.0
    lines = {"slip": slip, "0": 0.0 * s, "1": 0.0 * s + width, "exit": exits}
    lines["2"] = 0.0 * s + 2.0 * width
    found = Driven([], {name: beside(*road, left) for name, left in lines.items()})
    found.lanes["slip"] = found.lanes["slip"][:371]
    found.lanes["2"] = found.lanes["2"][495:]  # the first have changed to it there

    def add(speed, start, first, last, begin):
        name, length = str(len(found.tracks)), speed * rng.uniform(3.5, 6.0)
        share = ramp(s, begin, length)
        left = lines[first] * (1.0 - share) + lines[last] * share
        found.tracks.append(
            drive(rng, name, road, lambda at: np.interp(at, s, left), speed, start)
        )
        if first != last and last != "exit":
            at = int(np.argmax(share > 0.5))
            found.changes.append((name, beside(*road, left)[at]))

    for lane, every in (("slip", 11.0), ("0", 5.0), ("1", 5.0)):
        start = rng.uniform(0.0, 5.0)
        while start < 60.0 * minutes:
            speed, begin = rng.uniform(20.0, 30.0), rng.uniform(100.0, 600.0)
            other = lane
            if lane == "slip":
                speed, begin, other = rng.uniform(17.0, 23.0), 170.0, "0"
                begin += 150.0 * rng.beta(2.0, 2.0)
            elif rng.random() < 0.3:
                other = {"0": "exit", "1": "2"}[lane]
                begin = -500.0 if other == "exit" else rng.uniform(450.0, 620.0)
            elif rng.random() < 0.25:
                other = {"0": "1", "1": "0"}[lane]
            add(speed, start, lane, other, begin)
            start += rng.exponential(every) + 1.5
    return found


def late_exit(seed=0, *, minutes=8.0, width=3.5):
    """A lane and an exit that is beside it from 300 to 385 m, and entered late.

    `changes` are (track, place [2] m) over the lane's edge.
    """
    rng, s = np.random.default_rng(seed), np.arange(801.0)
    road = curve(s, 0.0 * s, heading=0.4)
    exits = -width - np.maximum(s - 385.0, 0.0) ** 2 / 1400.0
    lanes = {"0": road[0], "exit": beside(*road, exits)[330:]}
    found, start = Driven([], lanes), 0.0
    while start < 60.0 * minutes:
        name, speed = str(len(found.tracks)), rng.uniform(18.0, 26.0)
        share = ramp(s, rng.uniform(290.0, 330.0), speed * rng.uniform(3.0, 4.0))
        left = share * exits * (rng.random() < 0.3)
        made = (rng, name, road, lambda at, left=left: np.interp(at, s, left))
        found.tracks.append(drive(*made, speed, start))
        if left[-1]:
            at = int(np.argmax(share > 0.5))
            found.changes.append((name, beside(*road, left)[at]))
        start += rng.exponential(4.0) + 1.5
    return found


def crossing(seed=0, *, minutes=8.0, arm=60.0, width=3.5):
    """Four arms with a lane each way: straight on, left and right from each."""
    rng, found = np.random.default_rng(seed), Driven([], {})
    for number in range(4):
        for turn, sign, radius in (
            ("on", 0, 1.0),
            ("left", 1, 10.0),
            ("right", -1, 6.0),
        ):
            bend = arm + 0.5 * sign * width - radius if sign else 2.0 * arm
            arc = radius * np.pi / 2.0 if sign else 0.0
            s = np.arange(0.0, (2.0 * bend + arc if sign else 2.0 * arm), 0.1)
            kappa = np.where((s >= bend) & (s < bend + arc), sign / radius, 0.0)
            points, heading = curve(s, kappa, (-arm, -0.5 * width))
            turned = 0.5 * np.pi * number
            c, sn = np.cos(turned), np.sin(turned)
            points = points @ np.array([[c, sn], [-sn, c]])
            road = points[::10], heading[::10] + turned
            found.lanes[f"{number} {turn}"] = road[0]
            start = rng.uniform(0.0, 10.0)
            while start < 60.0 * minutes:
                made = (rng, str(len(found.tracks)), road, lambda x: 0.0 * x)
                found.tracks.append(drive(*made, rng.uniform(6.0, 11.0), start))
                start += rng.exponential(20.0) + 2.0
    return found
