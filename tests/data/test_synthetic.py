"""Synthetic traffic: deterministic, collision free, human, lawful."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from rcirl_jax.data.formats.synthetic import reader as synthetic
from rcirl_jax.data.formats.synthetic.roads import ROADS
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Recording, Track
from tests.helpers.logs import refused

DEFAULT = spec_root() / "sources" / "synthetic.toml"
SMALL = """
source = "test"
licence = "none"
rate_hz = 10.0
warmup_s = 5.0
position_noise_m = {noise}
[[recordings]]
road = "{road}"
count = {count}
duration_s = {duration}
density_veh_per_km = 14.0
seed = {seed}
"""


def make(folder: Path, **changes) -> list[Recording]:
    values = {"noise": 0.0, "road": "urban_turn_left", "count": 1}
    values |= {"duration": 10.0, "seed": 3} | changes
    path = folder / "small.toml"
    path.write_text(SMALL.format(**values))
    return list(synthetic.recordings(path, load_toml(DEFAULT)))


@pytest.fixture(scope="module")
def default() -> list[Recording]:
    return list(synthetic.recordings(DEFAULT, load_toml(DEFAULT)))


def positions(recording: Recording) -> np.ndarray:
    return np.concatenate([np.stack([t.x, t.y]) for t in recording.tracks], axis=1)


def boxes(track: Track) -> np.ndarray:
    """Oriented boxes as shapely polygons, one per sample."""
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * 0.5
    along, across = corners[:, 0] * track.length, corners[:, 1] * track.width
    c, s = np.cos(track.heading)[:, None], np.sin(track.heading)[:, None]
    x = track.x[:, None] + along * c - across * s
    y = track.y[:, None] + along * s + across * c
    return shapely.polygons(np.stack([x, y], axis=-1))


def overlaps(recording: Recording) -> int:
    """Pairs of touching boxes over all samples, by shapely."""
    frame = np.concatenate([np.round(t.t * 10).astype(int) for t in recording.tracks])
    centre = positions(recording).T
    reach = np.concatenate([np.full(t.t.size, t.length) for t in recording.tracks])
    shapes = np.concatenate([boxes(track) for track in recording.tracks])
    found = 0
    for now in np.unique(frame):
        rows = np.flatnonzero(frame == now)
        apart = np.linalg.norm(centre[rows, None] - centre[None, rows], axis=-1)
        near = apart < 0.5 * (reach[rows, None] + reach[None, rows]) + 3.0
        a, b = np.nonzero(np.triu(near, k=1))
        found += int(shapely.intersects(shapes[rows[a]], shapes[rows[b]]).sum())
    return found


def crossings(recording, is_wanted):
    """(track, time, lane) of every front bumper over the line of a wanted lane."""
    for lane in filter(is_wanted, recording.lanes):
        for track in recording.tracks:
            time = front_crossing(track, lane.stop_line)
            if time is not None:
                yield track, time, lane


def front_crossing(track: Track, line: np.ndarray) -> float | None:
    """Time of the front bumper's path across a stop line, by shapely."""
    half = 0.5 * track.length
    x = track.x + half * np.cos(track.heading)
    y = track.y + half * np.sin(track.heading)
    steps = np.stack([np.stack([x[:-1], y[:-1]], 1), np.stack([x[1:], y[1:]], 1)], 1)
    hit = shapely.intersects(shapely.linestrings(steps), shapely.linestrings(line))
    return float(track.t[1:][hit][0]) if hit.any() else None


def test_seed_decides_and_the_batch_does_not(tmp_path):
    first, again, other = (make(tmp_path, seed=seed, noise=0.03) for seed in (3, 3, 4))
    np.testing.assert_array_equal(positions(first[0]), positions(again[0]))
    assert not np.array_equal(positions(first[0]), positions(other[0]))
    alone, together = make(tmp_path)[0], make(tmp_path, count=3)
    np.testing.assert_allclose(positions(alone), positions(together[0]), atol=1e-6)
    assert len({recording.group for recording in together}) == 3


def test_default_is_large_valid_and_human(default):
    assert {r.name.split("-")[0] for r in default} == set(ROADS)
    tracks = [t for r in default for t in r.tracks if t.t.size > 5]
    assert sum(t.t.size >= 200 for t in tracks) >= 500
    a = np.concatenate([np.gradient(t.speed, 0.1) for t in tracks])
    j = np.concatenate([np.gradient(np.gradient(t.speed, 0.1), 0.1) for t in tracks])
    assert -8.0 < a.min() < a.max() < 2.6
    # hard braking is rare in human driving, but everyday braking is there
    assert np.mean(a < -4.0) < 2e-3
    assert np.mean(a < -1.0) > 0.01
    assert np.mean(np.abs(j) > 5.0) < 2e-3


def test_boxes_never_overlap(default):
    for recording in default:
        assert overlaps(recording) == 0, recording.name


def test_positions_agree_with_heading_speed_and_clock(tmp_path):
    for road in ROADS:
        for track in make(tmp_path, road=road)[0].tracks:
            np.testing.assert_allclose(np.diff(track.t), 0.1, atol=1e-9)
            vx, vy = np.gradient(track.x, 0.1), np.gradient(track.y, 0.1)
            moving = slice(1, -1)
            speed = np.hypot(vx, vy)[moving]
            np.testing.assert_allclose(speed, track.speed[moving], atol=0.12)
            fast = speed > 1.0
            gap = np.arctan2(vy, vx)[moving][fast] - track.heading[moving][fast]
            wrapped = (gap + np.pi) % (2 * np.pi) - np.pi
            assert np.all(np.abs(wrapped) < 0.05), (road, track.id)


def test_red_lights_are_respected(default):
    counts = {"green": 0, "yellow": 0, "red": 0}
    for recording in default:
        signals = {signal.id: signal for signal in recording.signals}
        assert all(s.is_recorded and s.start[0] <= 0.0 for s in recording.signals)
        for _, time, lane in crossings(recording, lambda lane: lane.signal_ids):
            for signal in map(signals.get, lane.signal_ids):
                at = np.searchsorted(signal.start, time, side="right") - 1
                counts[signal.state[at]] += 1
    assert counts["green"] > 50
    assert counts["yellow"] > 0
    assert counts["red"] == 0


def test_stop_signs_are_obeyed(default):
    crossed = stood = 0
    for recording in default:
        for track, time, _ in crossings(recording, lambda lane: lane.stop_sign):
            if time > 6.0:  # earlier ones may have stood before the recording began
                crossed += 1
                before = (track.t < time) & (track.t > time - 5.0)
                stood += bool(np.any(track.speed[before] < 0.1))
    assert crossed > 10
    assert stood == crossed


def test_lane_changes_happen_and_are_smooth(default):
    roads = [r for r in default if "highway_straight" in r.name]
    tracks = [track for recording in roads for track in recording.tracks]
    assert all(np.abs(np.diff(track.y)).max() < 0.45 for track in tracks)
    assert sum(abs(track.y[-1] - track.y[0]) > 2.5 for track in tracks) > 30


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("rate_hz = 10.0", "rate_hz = -1.0", "rate_hz"),
        ("seed = 7", "sead = 7", "recordings[7]: sead"),
        ("[1.0, 0.1, 0.7, 1.3]", "[1.0, 0.1]", "drivers: speed_factor"),
        ("jam_gap_m = [1.0, 4.0]", "jam_gap_m = [4.0, 1.0]", "drivers: jam_gap_m"),
    ],
)
def test_bad_toml_is_one_clear_line(tmp_path, old, new, field):
    text = DEFAULT.read_text()
    assert old in text
    path = tmp_path / "bad.toml"
    path.write_text(text.replace(old, new, 1))
    line = refused(synthetic.recordings, path, load_toml(path))
    assert str(path) in line
    assert field in line
