"""Tables of a user's own, in the forms that people have them, small and sound."""

import contextlib
import gzip
from pathlib import Path

import pyarrow
import pyarrow.feather
import pyarrow.parquet

from benchmarks.reliability.fuzz.targets import Target
from rcirl_jax.data.importers.csv.suggest import suggested
from rcirl_jax.data.importers.recognise import recognised_format
from rcirl_jax.errors import InputError
from tests.data.importers import people, writers


def make_csv(folder: Path) -> tuple[Path, list[Path]]:
    """Three cars."""
    log = folder / "log.csv"
    writers.table(log, writers.CSV_COLUMNS, writers.csv_rows(count=25))
    return folder, [log]


def make_columns(folder: Path) -> tuple[Path, list[Path]]:
    """Three cars in Parquet and in Feather."""
    made = list(zip(*writers.csv_rows(count=25), strict=True))
    names = writers.CSV_COLUMNS
    table = pyarrow.table({n: list(c) for n, c in zip(names, made, strict=True)})
    files = [folder / "a.parquet", folder / "b.feather"]
    pyarrow.parquet.write_table(table, files[0])
    pyarrow.feather.write_feather(table, files[1])
    return folder, files


def make_spreadsheet(folder: Path) -> tuple[Path, list[Path]]:
    """Three cars as a spreadsheet writes them, packed and not."""
    text = people.text(people.rows()[:150], between=";", decimal=",")
    log, packed = folder / "log.csv", folder / "other.csv.gz"
    log.write_text(text)
    packed.write_bytes(gzip.compress(text.encode()))
    return folder, [log, packed]


PEOPLE = people.SPEC.format(
    more='heading_convention = "ccw_from_x"\nmax_bad_rows = 0.5',
    columns="\n".join(f'{name} = "{name}"' for name in people.HEADER),
    units='t = "s"\nx = "m"\ny = "m"\nspeed = "m/s"\nheading = "rad"',
    rest="[scale]\nspeed = 1.0\n[offset]\nspeed = 0.0\n[table]\ndelimiter = ';'",
)


def make_degrees(folder: Path) -> tuple[Path, list[Path]]:
    """Two cars with times as text, degrees, velocities and yes or no."""
    head = "time;id;lon;lat;vx;vy;auto"
    rows = [
        f"2024-05-20T10:00:{k / 10:06.3f}Z;{car};{23.7 + k * 2e-5:.7f};"
        f"{37.9 + car * 4e-5:.7f};17.5;0.0;{'yes' if car else 'no'}"
        for k in range(25)
        for car in (0, 1)
    ]
    log = folder / "log.csv"
    log.write_text("\n".join([head, *rows]) + "\n")
    return folder, [log]


DEGREES = """max_bad_rows = 0.2
automated_values = ["yes"]
[columns]
t = "time"
id = "id"
lon = "lon"
lat = "lat"
vx = "vx"
vy = "vy"
automated = "auto"
[units]
t = "iso"
"""


def make_frames(folder: Path) -> tuple[Path, list[Path]]:
    """Two cars side by side in every row."""
    rows = [f"{k / 10:.1f},{1.5 * k},0.0,{1.5 * k - 20},3.5" for k in range(25)]
    log = folder / "log.csv"
    log.write_text("\n".join(["t,x1,y1,x2,y2", *rows]) + "\n")
    return folder, [log]


FRAMES = """max_bad_rows = 0.2
[columns]
t = "t"
x = "x{id}"
y = "y{id}"
"""


def make_drives(folder: Path) -> tuple[Path, list[Path]]:
    """Two vehicles, a row each that repeats its last columns."""
    rows = []
    for car, count in ((1, 25), (2, 20)):
        steps = "".join(f"; {1.5 * k}; {3.5 * car}; {k / 10}" for k in range(count))
        rows.append(f"{car}; Car{steps}; ")
    log = folder / "log.csv"
    log.write_text("\n".join(["track_id; type; x; y; time", *rows]) + "\n")
    return folder, [log]


DRIVES = """max_bad_rows = 0.2
[columns]
t = "time"
id = "track_id"
x = "x"
y = "y"
[table]
repeating = 3
"""


def suggest_target(folder: Path) -> Target:
    """Tables of which nothing is said: the TOML suggested, the format recognised."""
    files = []
    for number, make in enumerate((make_csv, make_degrees, make_frames, make_drives)):
        place = folder / str(number)
        place.mkdir(parents=True)
        files += make(place)[1]

    def read() -> None:
        for file in files:
            with contextlib.suppress(InputError):
                recognised_format(file)
        for file in files:
            suggested(file)

    return Target(read, files)
