"""A CommonRoad 2020a scenario: a car, a pedestrian, a parked car, a light."""

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers import writers as w
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import samples, straight

T = np.arange(120) * w.DT


def write(folder):
    """One file with two lanelets in a row and a light at the end of the first."""
    ends = '<stopLine></stopLine><trafficLightRef ref="7"/><successor ref="2"/>'
    step = w.SPEED * w.DT
    late = [w.state(k, 30.0 + 0.9 * k, 0.0, speed=9.0) for k in range(31, 100)]
    walk = [
        w.state(k, 60.0, 4.0 + 0.12 * k, speed=1.2, heading=np.pi / 2)
        for k in range(1, 120)
    ]
    body = (
        w.lanelet("1", extra=ends)
        + w.lanelet(
            "2", left=[(200, 1.75), (500, 1.75)], right=[(200, -1.75), (500, -1.75)]
        )
        + w.car("10", count=120)
        + _moving(
            "11",
            "car",
            w.BOX,
            late,
            w.state(30, 57.0, 0.0, tag="initialState", speed=9.0),
        )
        + _moving(
            "12",
            "pedestrian",
            "<circle><radius>0.3</radius></circle>",
            walk,
            w.state(0, 60.0, 4.0, tag="initialState", speed=1.2, heading=np.pi / 2),
        )
        + w.standing("30")
        + w.light("7", [("green", 100), ("yellow", 30), ("red", 200)])
    )
    path = w.commonroad(folder / "USA_Test-1_1_T-1.xml", body)
    first = straight(T, (0.0, 0.0), 0.0, w.SPEED, size=(4.4, 1.8))
    other = straight(T, (30.0, 0.0), 0.0, 9.0, size=(4.4, 1.8))
    person = straight(
        T, (60.0, 4.0), np.pi / 2, 1.2, kind=Kind.PEDESTRIAN, size=(0.6, 0.6)
    )
    assert step == 1.5
    return Fixture(
        input=folder,
        assumed=(2, 0, 0),
        rate_hz=10.0,
        tracks={
            "10": first,
            "11": samples(other, np.arange(30, 100)),
            "12": person,
            "30": straight(
                T, (50.0, -5.0), 0.0, 0.0, kind=Kind.STATIC, size=(4.4, 1.8)
            ),
        },
        num_lanes=2,
        num_signals=1,
        files=(path,),
        numbers={path: "<x>([^<]*)</x>"},
        is_counted=True,
    )


def _moving(name, kind, shape, states, first):
    return (
        f'<dynamicObstacle id="{name}"><type>{kind}</type><shape>{shape}</shape>'
        f"{first}<trajectory>{''.join(states)}</trajectory></dynamicObstacle>"
    )


# ---------------------------------------------------------------------- harms


def file_of(*parts, **options):
    """What writes a file of other parts."""
    return lambda fixture: w.commonroad(fixture.files[0], *parts, **options)


def moved(*states):
    return file_of(w.lanelet(), w.car(states=list(states)))


def text(content):
    return lambda fixture: fixture.files[0].write_text(content)


def lit(colour, duration):
    return file_of(ROAD, w.light("7", [(colour, duration)]))


ROAD = w.lanelet() + w.car()
FEET = [w.state(k, 1.5 * k / w.FOOT, 0) for k in range(1, 40)]
LONG = w.BOX.replace("4.4", "4400")
HEAD = '<commonRoad commonRoadVersion="2020a" timeStepSize="x"/>'
# what is written, and what the line says
HARMS = {
    "lanelet: none": file_of(w.car()),
    "state 1: velocity: missing": moved(w.state(1, 1.5, 0, drop=("velocity",))),
    "x: 'nan'": moved(w.state(1, "nan", 0)),
    "feet taken for metres": moved(*FEET),
    # a clock of a century
    "time: 2e+10: expected steps up to": moved(w.state(2 * 10**10, 3, 0)),
    "time: 2: expected increasing": moved(w.state(3, 4.5, 0), w.state(2, 3, 0)),
    "lane id: 1": file_of(w.lanelet(), ROAD),
    "shape: blob": file_of(w.lanelet(), w.car(shape="<blob/>")),
    "length: 4400": file_of(w.lanelet(), w.car(shape=LONG)),
    "leftBound": file_of(w.lanelet(left=[(0, 1)]), w.car()),
    "pink for 9": lit("pink", 9),
    "red for 1e-09": lit("red", 1e-9),
    "role: odd": file_of(
        w.lanelet(), w.car(version="2018b").replace("dynamic<", "odd<"), version="2018b"
    ),
    "root: 'other'": text("<other/>"),
    "commonRoadVersion: 1999": text('<commonRoad commonRoadVersion="1999"/>'),
    "timeStepSize: x": text(HEAD),
    "xml: ": text('<?xml version="1.0" encoding="klingon"?><commonRoad/>'),
}
OPTIONS = [{"groups": name} for name in ("../groups.csv", "/etc/passwd", "x" * 300)]
