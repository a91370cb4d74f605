"""Every importer, one set of invariants: what is written is what is read.

The formats are the modules of tests/data/formats/fixtures with a function `write`; a
module named otherwise than its format says so by FORMAT.
"""

import collections
import functools
import os
import pickle
import re

import numpy as np
import pytest
import shapely

from rcirl_jax.data.formats import IMPORTERS, parts, read_part, read_recordings
from rcirl_jax.data.formats.recognise import recognised_format
from rcirl_jax.data.formats.tracks import of_one_name
from rcirl_jax.data.importing import ImportConfig, digest, import_logs
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.quality import assumed
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Kind
from tests.data.formats import fixtures as formats
from tests.data.formats import writers as w
from tests.data.formats.fixtures import format_of, has_note, waymo
from tests.helpers import logs
from tests.helpers.logs import refused

SPEED_TOLERANCE_MPS = 0.3  # m/s
SIZE_TOLERANCE_M = 0.02  # m
TIME_TOLERANCE_S = 0.006  # s, stamps rounded to 10 ms


MODULES = formats.modules()


def write(name, folder):
    folder.mkdir(parents=True, exist_ok=True)
    return MODULES[name].write(folder)


def read(name, fixture):
    return list(read_recordings(format_of(name), fixture.input))


@pytest.fixture(scope="module", params=sorted(MODULES))
def name(request):
    return request.param


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Name -> a fixture that nothing is done to; each is written once."""
    return functools.cache(lambda name: write(name, tmp_path_factory.mktemp(name)))


@pytest.fixture(scope="module")
def sound(name, written):
    """A fixture that nothing is done to, and its recordings."""
    return written(name), read(name, written(name))


def find(recordings, label, expected):
    """The track of this id, in the recording where it has as many samples."""
    found = [t for r in recordings for t in r.tracks if t.id == label]
    fitting = [track for track in found if track.t.size == expected.t.size]
    assert fitting, (label, expected.t.size, [track.t.size for track in found])
    return fitting[0]


def test_every_format_has_a_fixture():
    """A new importer comes with a fixture; synthetic traffic is its own."""
    assert {format_of(name) for name in MODULES} == set(IMPORTERS) - {"synthetic"}


def spec_of(name):
    return load_toml(spec_root() / "sources" / f"{format_of(name)}.toml")


def test_what_was_written_is_found(sound):
    fixture, recordings = sound
    for label, expected in fixture.tracks.items():
        track = find(recordings, label, expected)
        assert track.kind == expected.kind, label
        for field in ("length", "width"):
            found, meant = getattr(track, field), getattr(expected, field)
            assert abs(found - meant) <= SIZE_TOLERANCE_M, (label, field, found, meant)
        np.testing.assert_allclose(track.t, expected.t, atol=TIME_TOLERANCE_S)
        apart = np.hypot(track.x - expected.x, track.y - expected.y)
        assert apart.max() <= fixture.tolerance_m, (label, apart.max())
        fast = np.abs(track.speed - expected.speed)
        assert fast.max() <= SPEED_TOLERANCE_MPS, (label, fast.max())
        turn = np.abs(np.angle(np.exp(1j * (track.heading - expected.heading))))
        assert turn.max() <= fixture.heading_tolerance, (label, turn.max())
    assert max(len(r.lanes) for r in recordings) >= fixture.num_lanes
    assert max(len(r.signals) for r in recordings) >= fixture.num_signals


def test_every_recording_is_sound(sound):
    fixture, recordings = sound
    assert recordings
    names = [recording.name for recording in recordings]
    assert len(set(names)) == len(names)
    found, meant = recordings[0].start_s, fixture.start_s
    assert (found is None) == (meant is None)
    assert found is None or found == pytest.approx(meant, abs=1e-3)
    for recording in recordings:
        validate_recording(recording)
        assert recording.rate_hz == pytest.approx(fixture.rate_hz, rel=1e-6)
        for text in (recording.source, recording.licence):
            assert text.strip()
            assert not text.lower().startswith("unknown")
        begin = min(track.t[0] for track in recording.tracks)
        assert begin == pytest.approx(0.0, abs=1e-6)
        for track in recording.tracks:
            assert isinstance(track.kind, Kind)
            for field in ("t", "x", "y", "heading", "speed"):
                assert getattr(track, field).dtype == np.float64
            assert np.all(np.diff(track.t) > 0.0)
            # float32 on the device resolves a centimetre up to about 100 km
            assert max(np.abs(track.x).max(), np.abs(track.y).max()) < 1e5
        for lane in recording.lanes:
            assert lane.centre.dtype == np.float64


def counts(recordings):
    """(limits, widths, sizes) that are a guess."""
    found = collections.Counter()
    for recording in recordings:
        found.update(assumed(recording))
    return found["speed limit"], found["width"], found["size"]


def test_its_files_tell_the_format_and_what_they_do_not_say_is_counted(name, sound):
    fixture, recordings = sound
    assert recognised_format(fixture.input) == format_of(name)
    assert counts(recordings) == fixture.assumed


def test_lanes_lie_under_the_vehicles(sound):
    """Tracks and lanes share one frame: most vehicles have a lane below them."""
    fixture, recordings = sound
    if fixture.num_lanes == 0:
        assert not any(recording.lanes for recording in recordings)
        return
    shares = []
    for recording in recordings:
        lines = shapely.MultiLineString([lane.centre for lane in recording.lanes])
        cars = [track for track in recording.tracks if track.kind == Kind.VEHICLE]
        gaps = [shapely.distance(lines, shapely.points(t.x, t.y)) for t in cars]
        shares += [np.mean(gap < 4.0) for gap in gaps]
    assert np.median(shares) > 0.9, shares


def digests(recordings):
    return [(digest(r), r.group, r.notes, r.signals == ()) for r in recordings]


def test_parts_read_apart_make_up_the_whole(name, sound):
    """Read again, on other machines, every input gives the same to the bit."""
    fixture, whole = sound
    found, spec = parts(format_of(name), fixture.input)
    apart = [r for part in found for r in read_part(format_of(name), part, spec)]
    assert digests(apart) == digests(whole)
    again = read_part(format_of(name), fixture.input, spec)
    assert iter(again) is iter(again)  # one recording at a time
    assert digests(again) == digests(whole)


@pytest.mark.parametrize("name", ["apollo", "nuplan", "ros2"])
def test_windows_hold_the_scenes_of_the_drive(name, written, monkeypatch):
    """Road users keep their names; surroundings are shortened to those of 8 s."""
    monkeypatch.setattr(long_logs, "BEFORE_S", 1.0)
    monkeypatch.setattr(long_logs, "AFTER_S", 2.5)
    place = written(name).input
    whole = logs.only(name, place)
    found = logs.read(name, place, window_s=3.0)
    assert [one.name for one in found] == [f"{whole.name}-{k:03d}" for k in range(3)]
    assert {one.piece_of for one in found} == {whole.name}
    assert len({one.group for one in found}) == 1
    begins = [one.scenes_within[0] for one in found]
    np.testing.assert_allclose(begins, [0.0, 3.0, 6.0], atol=0.7)
    shares = [one.progress for one in found]
    assert 0.0 < shares[0] <= shares[1] <= shares[2] <= 1.0
    users = logs.tracks_of(whole)
    assert {track.id for one in found for track in one.tracks} == set(users)
    for track in (track for one in found for track in one.tracks):
        same = users[track.id]
        rows = np.searchsorted(same.t, track.t - 1e-6)
        np.testing.assert_allclose(same.t[rows], track.t, atol=1e-6)
        own = np.hypot(*np.diff([track.x, track.y]))
        moved = np.hypot(*np.diff([same.x[rows], same.y[rows]]))
        np.testing.assert_allclose(own, moved, atol=1e-6)
    if name == "nuplan":  # others fit their lanes to each window
        one, apart = logs.scenes_of([whole], 1.5), logs.scenes_of(found, 1.5)
        assert len(one) > 40
        assert set(apart) == set(one)


MAPS = {".osm", ".osm_xy", ".gpkg", ".pb"}  # of formats that may come without


@pytest.mark.parametrize("name", ["interaction", "l5", "levelx", "nuplan"])
def test_without_a_map_lanes_follow_the_paths(name, tmp_path):
    fixture = write(name, tmp_path)
    for file in tmp_path.rglob("*"):
        if file.suffix in MAPS:
            file.unlink()
    made = read(name, fixture)[0]
    assert made.lanes[0].id.startswith("lane-")
    assert has_note(made, "no map")


TABLES = ("csv", "interaction", "levelx", "ngsim_pairs", "openacc")


@pytest.mark.parametrize("name", TABLES)
def test_a_table_without_rows_is_empty(name, tmp_path):
    """It is a recording without traffic, which an import counts and skips."""
    log = write(name, tmp_path).files[0]
    lines = log.read_text().splitlines(keepends=True)
    head = next(k for k, line in enumerate(lines) if line[:1].isdigit())
    log.write_text("".join(lines[:head]))
    (made, *_) = read_recordings(format_of(name), log)
    assert made.tracks == ()
    assert has_note(made, "rows: none")


def test_the_longest_track_of_one_id_counts(tmp_path):
    fixture = waymo.write(tmp_path)
    waymo.cars(count=2)(fixture)
    made = logs.only("waymo", fixture.input)
    assert [track.id for track in made.tracks] == ["1"]
    assert has_note(made, "1 tracks with the id of another left out")
    parts = (w.lanelet(), w.car(count=20), w.car(count=40))
    made = logs.only("commonroad", w.commonroad(tmp_path / "a.xml", *parts))
    assert [track.t.size for track in made.tracks] == [40]
    assert has_note(made, "1 tracks with the id of another left out")
    kept, notes = of_one_name([*made.tracks] * 3)
    assert (len(kept), notes) == (3, [])


def test_what_the_users_own_toml_states_is_no_guess(written, tmp_path):
    """Its limit is that of fitted lanes, its [ego] the size of the recording car."""
    fixture, source = written("apollo"), tmp_path / "drives.toml"
    source.write_text("rate_hz = 10.0\n")
    assert counts(logs.read("apollo", fixture.input, source)) == fixture.assumed
    source.write_text("speed_limit = 13.9\n[ego]\nlength = 4.4\nwidth = 1.9\n")
    made = logs.only("apollo", fixture.input, source)
    assert counts([made]) == (0, 4, 0)
    assert {lane.speed_limit for lane in made.lanes} == {made.default_speed_limit}
    assert made.default_speed_limit == 13.9


def imported(name, fixture, output):
    """The manifest of an import as by its command; 3 s of future are enough."""
    collect = CollectConfig(
        require_obstacles=False, require_speed_change=False, min_future_s=3.0
    )
    config = ImportConfig(format=format_of(name), collect=collect, test_fraction=0.0)
    return import_logs(input_files(format_of(name), fixture.input), output, config)


def test_imports_end_to_end(name, sound, tmp_path):
    """Every fixture is long enough for a scene of 3 s."""
    manifest = imported(name, sound[0], tmp_path / "dataset")
    assert manifest.count > 0
    assert manifest.sources
    spec = spec_of(name)
    known = [spec, *spec.get("provenance", [])]
    assert any(entry.get("source") for entry in known)
    assert spec["licence"].strip()
    licences = {entry.get("licence", spec["licence"]) for entry in known}
    assert {entry["licence"] for entry in manifest.sources} <= licences


# ---------------------------------------------------------------- damaged files


def cut_short(path):
    """Cut at nine tenths: text in the middle of the line there."""
    content = path.read_bytes()
    cut = int(0.9 * len(content))
    if b"\0" not in content:
        begin, end = content.rfind(b"\n", 0, cut) + 1, content.find(b"\n", cut)
        cut = (begin + (end if end >= 0 else len(content))) // 2
    path.write_bytes(content[:cut])


class Bomb:
    """Unpickling it creates a folder."""

    def __init__(self, target):
        self.target = str(target)

    def __reduce__(self):
        return os.mkdir, (self.target,)


@pytest.mark.parametrize("damage", ["cut short", "a pickle"])
def test_damaged_files(name, damage, tmp_path):
    """Each in its turn; an import says the same line and leaves nothing."""
    fixture, target = write(name, tmp_path / "log"), tmp_path / "executed"
    for path in fixture.files:
        content = path.read_bytes()
        if damage == "cut short":
            cut_short(path)
        else:
            path.write_bytes(pickle.dumps(Bomb(target)) * 3)
        line = refused(read, name, fixture)
        assert path.name in line
        assert len(line) < 1000
        assert line in refused(imported, name, fixture, tmp_path / "dataset")
        assert not (tmp_path / "dataset").exists()
        assert not target.exists(), f"{path.name}: code was executed"
        path.write_bytes(content)


def test_a_word_for_a_number_is_refused_or_its_row_counted(name, tmp_path):
    fixture = write(name, tmp_path)
    for path, pattern in fixture.numbers.items():
        text = path.read_text()
        found = list(re.finditer(pattern, text, re.MULTILINE))
        start, end = found[len(found) // 2].span(1)
        path.write_text(text[:start] + '"west"' + text[end:])
        if fixture.drops_rows and path.suffix in (".csv", ".txt"):
            assert sum(made.rows.unreadable for made in read(name, fixture)) == 1
        else:
            assert path.name in refused(read, name, fixture)
        path.write_text(text)


def of_all(table):
    """(name, number or words, what is done) of every entry of a table of fixtures."""
    found = []
    for name, module in sorted(MODULES.items()):
        entries = getattr(module, table, {})
        pairs = entries.items() if isinstance(entries, dict) else enumerate(entries)
        found += [pytest.param(name, *pair, id=f"{name}: {pair[0]}") for pair in pairs]
    return found


@pytest.mark.parametrize(("name", "words", "harm"), of_all("HARMS"))
def test_what_is_wrong_in_a_file_is_named(name, words, harm, tmp_path):
    """Values that no road, clock or user has; tables and fields of another form."""
    fixture = write(name, tmp_path)
    harm(fixture)
    line = refused(read, name, fixture)
    assert words in line
    assert "expected" in line
    assert line.startswith(str(tmp_path))


@pytest.mark.parametrize(("name", "number", "option"), of_all("OPTIONS"))
def test_what_is_wrong_in_an_option_is_named(name, number, option, written):
    (key,) = option
    line = refused(logs.read, format_of(name), written(name).input, **option)
    assert line.startswith(f"source TOML: {key}")


def test_options_of_the_recording_car_and_of_limits(name, sound):
    """Where a format has them: its size, who drives it, the limit of other lanes."""
    spec, place = spec_of(name), sound[0].input
    if "ego" in spec:
        size = {**spec["ego"], "length": 4.0, "width": 1.7}
        made = logs.read(format_of(name), place, ego=size, speed_limit=9.0)[0]
        ego = logs.tracks_of(made)["ego"]
        assert (ego.length, ego.width, made.default_speed_limit) == (4.0, 1.7, 9.0)
    if name in ("argoverse2", "l5", "waymo"):  # others record who drives
        for driver, is_other in (("automated", True), ("human", False)):
            found = logs.read(format_of(name), place, recording_car=driver)
            assert any(t.automated for r in found for t in r.tracks) == is_other


def test_missing_and_empty_inputs_are_one_line(name, tmp_path):
    form = format_of(name)
    line = refused(read_recordings, form, tmp_path / "nowhere")
    assert line.startswith(str(tmp_path / "nowhere"))
    assert str(tmp_path) in refused(lambda: list(read_recordings(form, tmp_path)))
