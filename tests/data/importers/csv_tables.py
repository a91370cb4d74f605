"""Tables of a user's own, in the forms that people have them, small and sound."""

from tests.data.importers import people, writers

STEPS = range(25)


def _text(head, rows):
    return "\n".join([head, *rows]) + "\n"


# two cars with times as text, degrees, velocities and yes or no
DEGREES = _text(
    "time;id;lon;lat;vx;vy;auto",
    [
        f"2024-05-20T10:00:{k / 10:06.3f}Z;{car};{23.7 + k * 2e-5:.7f};"
        f"{37.9 + car * 4e-5:.7f};17.5;0.0;{'yes' if car else 'no'}"
        for k in STEPS
        for car in (0, 1)
    ],
)
# two cars side by side in every row
FRAMES = _text(
    "t,x1,y1,x2,y2",
    [f"{k / 10:.1f},{1.5 * k},0.0,{1.5 * k - 20},3.5" for k in STEPS],
)
# two vehicles, a row each that repeats its last columns
DRIVES = _text(
    "track_id; type; x; y; time",
    [
        f"{car}; Car"
        + "".join(f"; {1.5 * k}; {3.5 * car}; {k / 10}" for k in STEPS[: 30 - 5 * car])
        + "; "
        for car in (1, 2)
    ],
)


def _plain():
    rows = (",".join(map(str, row)) for row in writers.csv_rows(count=25))
    return _text(",".join(writers.CSV_COLUMNS), rows)


def _columns(*names, **others):
    known = {name: name for name in names} | others
    return "[columns]\n" + "".join(f'{k} = "{v}"\n' for k, v in known.items())


BAD_ROWS = "max_bad_rows = 0.2\n"
# (text of the log, text of its TOML)
TABLES = [
    (_plain(), "long_bytes = 1\n" + _columns(*writers.CSV_COLUMNS)),
    (
        people.text(people.rows()[:150], between=";", decimal=","),
        people.SPEC.format(
            more='heading_convention = "ccw_from_x"\nmax_bad_rows = 0.5',
            columns="\n".join(f'{name} = "{name}"' for name in people.HEADER),
            units='t = "s"\nx = "m"\ny = "m"\nspeed = "m/s"\nheading = "rad"',
            rest="[scale]\nspeed = 1.0\n[table]\ndelimiter = ';'",
        ),
    ),
    (
        DEGREES,
        BAD_ROWS
        + 'automated_values = ["yes"]\n'
        + _columns("id", "lon", "lat", "vx", "vy", t="time", automated="auto")
        + '[units]\nt = "iso"\n',
    ),
    (FRAMES, BAD_ROWS + _columns("t", x="x{id}", y="y{id}")),
    (
        DRIVES,
        "long_bytes = 1\n"
        + BAD_ROWS
        + _columns("x", "y", t="time", id="track_id")
        + "[table]\nrepeating = 3\n",
    ),
]
