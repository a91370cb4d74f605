"""The importers: whole logs, small ones, with every file and the source TOML."""

import collections
import functools
import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType

from benchmarks.reliability.fuzz import tables
from benchmarks.reliability.fuzz.forms import toml_text
from benchmarks.reliability.fuzz.targets import Several, Target
from rcirl_jax.data import importers
from rcirl_jax.data.importers import read_recordings
from rcirl_jax.data.readers.zarr2 import StructuredArray
from rcirl_jax.runtime.specs import load_toml, spec_root
from tests.data.importers import writers
from tests.data.importers.formats import (
    Fixture,
    apollo,
    argoverse2,
    interaction,
    interaction_challenge,
    l5,
    levelx,
    levelx_highd,
    ngsim_pairs,
    nuplan,
    openacc,
    osm,
    ros2,
    waymo,
)

SHORT_S = 1.0  # s of a drive that are enough
ROWS = 60  # rows of a text table that are enough
FEW = 3  # road users of a scenario that are enough


@functools.lru_cache(maxsize=64)
def _parsed(path: Path, content: bytes) -> dict:
    return load_toml(path)


def parse_once() -> None:
    """In a process that does nothing else, parse the same sound TOML once.

    Again and again, it would take most of the time.
    """
    importers.load_toml = lambda path: _parsed(path, path.read_bytes())


def log_target(
    name: str,
    make: Callable[[Path], tuple[Path, list[Path]]],
    options: str = "",
    spec: str = "",
) -> Callable[[Path], Target]:
    """A whole import: what `make` writes, read as by the command.

    Args:
      name: of the format.
      make: folder -> (input, its files).
      options: lines put before the source TOML's.
      spec: text of the source TOML; "": the packaged one.
    """

    def target(folder: Path) -> Target:
        log = folder / "log"
        log.mkdir(parents=True)
        place, files = make(log)
        source = folder / "source.toml"
        packaged = load_toml(spec_root() / "sources" / f"{name}.toml")
        source.write_text(options + (spec or toml_text(packaged)))

        def read() -> None:
            collections.deque(read_recordings(name, place, source), maxlen=0)

        return Target(read, [*files, source], (str(log), "source TOML"))

    return target


def several(*makes: Callable[[Path], Target]) -> Callable[[Path], Target]:
    """One reader's targets, each in a folder of its own."""

    def target(folder: Path) -> Target:
        made = [make(folder / str(number)) for number, make in enumerate(makes)]
        return Several(made)

    return target


def _whole(fixture: Fixture) -> tuple[Path, list[Path]]:
    return fixture.input, list(fixture.files)


def _fewer_rows(file: Path, keep: Callable[[list[str]], bool]) -> None:
    """Only rows of a CSV whose cells say so; the head stays."""
    head, *rows = file.read_text().splitlines()
    kept = [row for row in rows if keep(row.split(","))]
    file.write_text("\n".join([head, *kept]) + "\n")


def make_commonroad(folder: Path) -> tuple[Path, list[Path]]:
    """Two cars, a parked one, lanelets with a light and a sign."""
    extra = '<trafficLightRef ref="5"/><trafficSignRef ref="6"/>'
    road = writers.lanelet("1", extra=extra) + writers.lanelet(
        "2", left=[(0, 5.25), (200, 5.25)], right=[(0, 1.75), (200, 1.75)]
    )
    traffic = writers.light("5", [("red", 30), ("green", 40)]) + writers.sign(
        "6", "274", "13.9"
    )
    cars = writers.car("10", count=25) + writers.car("11", y=3.5, count=25)
    goal = f"<position>{writers.BOX}</position>"
    parts = (road, traffic, cars, writers.standing(), writers.problem(goal))
    file = writers.commonroad(folder / "USA_Test-1_1_T-1.xml", *parts)
    groups = folder / "independent_groups.csv"
    groups.write_text(f"file,group\n{file.name},3\nUSA_Test-2_1_T-1.xml,4\n")
    return folder, [file, groups]


def make_ngsim(folder: Path, site: str = "") -> tuple[Path, list[Path]]:
    """Two cars, in either of the public forms: with a site's name or without."""
    rows = writers.ngsim_rows(count=25)
    rows += writers.ngsim_rows(vehicle=2, lane=1, local_x=6.0, count=25)
    if site:
        file = folder / "log.csv"
        return folder, [writers.ngsim_csv(file, rows, sites=[site] * len(rows))]
    return folder, [writers.ngsim_text(folder / "trajectories-0400-0415.txt", rows)]


def make_ngsim_pairs(folder: Path) -> tuple[Path, list[Path]]:
    """Two pairs."""
    fixture = ngsim_pairs.write(folder)
    for file in fixture.files:
        lines = file.read_text().splitlines()
        file.write_text("\n".join(lines[:ROWS]) + "\n")
    return _whole(fixture)


def _fewer_lanes(file: Path, place: Callable, shift: tuple[float, float]) -> None:
    """A map of few lanelets; linking all of them takes most of the time."""
    few = dict(list(osm.LANELETS.items())[:FEW])
    osm.lanelet_map(file, place, shift, few)


def make_levelx(folder: Path) -> tuple[Path, list[Path]]:
    """Three road users and the map of the place."""
    fixture = levelx.write(folder)
    tracks, meta, *_ = fixture.files
    few = {"0", "1", "4"}
    _fewer_rows(tracks, lambda cells: cells[1] in few and int(cells[3]) < ROWS)
    _cut_meta(meta, 1, (2, 3, 4), few)
    degrees = osm.in_degrees(levelx.ZONE, levelx.UTM_ORIGIN)
    _fewer_lanes(fixture.files[-1], degrees, levelx.SHIFT)
    return _whole(fixture)


def make_highd(folder: Path) -> tuple[Path, list[Path]]:
    """Two cars."""
    fixture = levelx_highd.write(folder)
    tracks, meta, _ = fixture.files
    few = {"1", "2"}
    _fewer_rows(tracks, lambda cells: cells[1] in few and int(cells[0]) <= ROWS)
    _cut_meta(meta, 0, (3, 4, 5), few)
    return _whole(fixture)


def _cut_meta(meta: Path, name: int, ends: tuple[int, int, int], few: set) -> None:
    """First and last frame and their number, of `ROWS` rows, of a few road users."""
    head, *rows = meta.read_text().splitlines()
    kept = [head]
    for row in rows:
        cells = row.split(",")
        if cells[name] in few:
            first, last, number = ends
            cells[last], cells[number] = str(int(cells[first]) + ROWS - 1), str(ROWS)
            kept.append(",".join(cells))
    meta.write_text("\n".join(kept) + "\n")


def make_interaction(folder: Path) -> tuple[Path, list[Path]]:
    """A scene and its map."""
    fixture = interaction.write(folder)
    for file in fixture.files[:2]:
        _fewer_rows(file, lambda cells: int(cells[1]) <= ROWS)
    _fewer_lanes(fixture.files[-1], osm.in_metres, interaction.SHIFT)
    return _whole(fixture)


def make_challenge(folder: Path) -> tuple[Path, list[Path]]:
    """Two cases of the challenge."""
    fixture = interaction_challenge.write(folder)
    _fewer_lanes(fixture.files[-1], osm.in_metres, interaction.SHIFT)
    return _whole(fixture)


def make_openacc(folder: Path) -> tuple[Path, list[Path]]:
    """A platoon of three."""
    fixture = openacc.write(folder)
    (log,) = fixture.files
    lines = log.read_text().splitlines()
    log.write_text("\n".join(lines[: 2 * ROWS]) + "\n")
    return fixture.input, [log, folder / "Vehicles_specifications.csv"]


def make_waymo(folder: Path) -> tuple[Path, list[Path]]:
    """A scenario of few road users."""
    users = [*waymo.road_users().items()][:FEW]
    tracks = [waymo.track(key, *values) for key, values in users]
    file = folder / "training.tfrecord-00000-of-01000"
    road = [_thinned(feature) for feature in waymo.map_features()]
    changes = {"objects_of_interest": [2320], "map_features": road}
    scenario = waymo.scenario(tracks=tracks, **changes)
    file.write_bytes(waymo.tfrecord([scenario]))
    return folder, [file]


def _thinned(feature: dict) -> dict:
    """A map feature with every tenth of its points; what has indices is left out."""
    return {
        name: value
        if name == "id"
        else {
            key: part[::10] if key == "polyline" else part
            for key, part in value.items()
            if not key.endswith(("_boundaries", "_neighbors"))
        }
        for name, value in feature.items()
    }


def make_nuplan(folder: Path) -> tuple[Path, list[Path]]:
    """A short log, its city's map and the list of maps."""
    fixture = nuplan.write(folder)
    log, road = fixture.files
    late = nuplan.START_US + round(SHORT_S * 1e6)
    database = sqlite3.connect(log)
    database.execute("DELETE FROM lidar_pc WHERE timestamp > ?", (late,))
    of_clouds = "lidar_pc_token NOT IN (SELECT token FROM lidar_pc)"
    for table in ("lidar_box", "traffic_light_status"):
        database.execute(f"DELETE FROM {table} WHERE {of_clouds}")
    database.execute("DELETE FROM ego_pose WHERE timestamp > ?", (late,))
    _packed(database)
    _packed(sqlite3.connect(road))
    return fixture.input, [log, road, folder / "maps" / "nuplan-maps-v1.0.json"]


def _packed(database: sqlite3.Connection) -> None:
    database.commit()
    database.execute("PRAGMA page_size = 512")
    database.execute("VACUUM")
    database.close()


def make_l5(folder: Path) -> tuple[Path, list[Path]]:
    """One scene; agents and frames are not compressed, so that values can change."""
    dataset = folder / "scenes" / "sample.zarr"
    fixture = l5.write(folder)
    shutil.rmtree(dataset)
    l5.write_zarr(dataset, scenes=1)
    for name in ("agents", "frames"):
        _decompress(dataset / name)
    files = [
        *(dataset / name / ".zarray" for name in ("scenes", "frames", "agents")),
        *(dataset / name / "0" for name in ("scenes", "frames", "agents")),
        dataset / "traffic_light_faces" / ".zarray",
        dataset / "traffic_light_faces" / "0",
        *fixture.files[-2:],
    ]
    return fixture.input, files


def _decompress(folder: Path) -> None:
    array = StructuredArray(folder, {})
    content = array.read(0, array.size)
    meta = json.loads((folder / ".zarray").read_text())
    for number in range(-(-array.size // array.chunk)):
        chunk = np.zeros(array.chunk, array.dtype)
        part = content[number * array.chunk : (number + 1) * array.chunk]
        chunk[: len(part)] = part
        (folder / str(number)).write_bytes(chunk.tobytes())
    (folder / ".zarray").write_text(json.dumps({**meta, "compressor": None}))


def make_apollo(folder: Path) -> tuple[Path, list[Path]]:
    """A short drive in two parts; every tenth pose."""
    often = ("/apollo/localization/pose", "/apollo/canbus/chassis")
    short = [item for item in apollo.drive() if item[1] < SHORT_S]
    kept = [item for item in short if item[0] not in often]
    for name in often:
        kept += [item for item in short if item[0] == name][::5]
    kept.sort(key=lambda item: item[1])
    files = [folder / f"2021.record.{part:05d}" for part in (0, 1)]
    half = len(kept) // 2
    files[0].write_bytes(apollo.record(kept[:half], chunk=20))
    files[1].write_bytes(apollo.record(kept[half:], chunk=20))
    return folder, files


def make_ros2(folder: Path) -> tuple[Path, list[Path]]:
    """A short drive in both storages, without checksums that would see any change."""
    kept = [item for item in ros2.drive() if item[2] < SHORT_S]
    bag = folder / "drive"
    bag.mkdir()
    plain = {"compression": CompressionType.NONE, "crcs": False}
    files = [ros2.mcap(bag / "a.mcap", kept, **plain), folder / "b.db3"]
    ros2.sqlite(files[1], files[0])
    ros2.metadata(bag, ["a.mcap"])
    return folder, [*files, bag / "metadata.yaml"]


LOGS = {
    "apollo": log_target("apollo", make_apollo),
    "argoverse2": log_target(
        "argoverse2", lambda folder: _whole(argoverse2.write(folder))
    ),
    "commonroad": log_target("commonroad", make_commonroad),
    "csv": several(
        log_target("csv", tables.make_csv),
        log_target("csv", tables.make_csv, "long_bytes = 1\n"),
        log_target("csv", tables.make_columns),
        log_target("csv", tables.make_spreadsheet, spec=tables.PEOPLE),
        log_target("csv", tables.make_degrees, spec=tables.DEGREES),
        log_target("csv", tables.make_frames, spec=tables.FRAMES),
        log_target("csv", tables.make_drives, "long_bytes = 1\n", spec=tables.DRIVES),
    ),
    "suggest": tables.suggest_target,
    "interaction": several(
        log_target("interaction", make_interaction),
        log_target("interaction", make_challenge),
    ),
    "l5": log_target("l5", make_l5),
    "levelx": several(
        log_target("levelx", make_levelx), log_target("levelx", make_highd)
    ),
    "ngsim": several(
        log_target("ngsim", make_ngsim),
        log_target("ngsim", functools.partial(make_ngsim, site="us-101")),
        log_target("ngsim", make_ngsim, "long_bytes = 1\n"),
    ),
    "ngsim_pairs": log_target("ngsim_pairs", make_ngsim_pairs),
    "nuplan": log_target("nuplan", make_nuplan),
    "openacc": log_target("openacc", make_openacc),
    "ros2": log_target("ros2", make_ros2),
    "waymo": log_target("waymo", make_waymo),
}
