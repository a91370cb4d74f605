"""Long Apollo drives: windows, made while the parts are read."""

import re

import numpy as np
import pytest

from rcirl_jax.data.formats import messages
from rcirl_jax.data.formats.apollo import reader as apollo
from tests.data.formats.fixtures import apollo as fixture
from tests.data.formats.test_apollo import (
    CHASSIS,
    LOCALIZATION,
    PERCEPTION,
    ROUTING,
    destinations,
    place,
    read,
    write,
)
from tests.helpers import logs
from tests.helpers.logs import refused, tracks_of


def long_drive(seconds=100.0):
    """Two cars ahead; one is hidden from 45 to 47 s, across a border of windows."""
    sent = [(ROUTING, 0.0, fixture.routing(*place(0)))]
    if seconds > 61.0:
        sent.append((ROUTING, 61.0, fixture.routing(*place(900))))
    for k in range(round(10 * seconds) + 1):
        t = 0.1 * k
        sent.append((LOCALIZATION, t, fixture.localization(t)))
        seen = ["12"] if 45.0 < t < 47.0 else ["12", "17"]
        users = fixture.road_users(np.array([t]))
        items = [fixture.obstacle(name, users[name], t) for name in seen]
        content = fixture.perceived(t, items)
        sent.append((PERCEPTION, t + fixture.LATE_S, content))
    return sorted(sent, key=lambda item: item[1])


@pytest.fixture(scope="module")
def long():
    """The messages of a long drive."""
    return long_drive()


@pytest.fixture
def in_pieces(monkeypatch):
    """Rows are handed on every five seconds."""
    monkeypatch.setattr(messages, "PIECE_S", 5.0)


def in_parts(folder, sent, count):
    """Files of a drive; the first."""
    size = -(-len(sent) // count)
    for part in range(count):
        some = sent[part * size : (part + 1) * size]
        write(folder / f"a.record.{part:05d}", some)
    return folder / "a.record.00000"


@pytest.mark.usefixtures("in_pieces")
def test_long_drive_is_read_in_windows(tmp_path, long):
    path = in_parts(tmp_path, long, 4)
    (whole,) = read(path)
    found = read(path, window_s=20.0)
    assert [made.scenes_within[0] for made in found] == [0.0, 20.0, 40.0, 60.0, 80.0]
    ego = tracks_of(found[2])["ego"]
    assert (ego.t[0], ego.seen_since) == (pytest.approx(35.0), 0.0)
    assert destinations(found[2]) == {"ego": place(0), "ego-leg2": place(900)}
    assert destinations(found[4]) == {"ego-leg2": place(900)}
    assert "17#2" in tracks_of(found[4])
    one, apart = logs.scenes_of([whole], 5.2), logs.scenes_of(found, 5.2)
    assert len(one) > 400
    assert set(apart) == set(one)
    for key, stations in one.items():
        np.testing.assert_allclose(apart[key], stations, atol=2e-2)


@pytest.mark.usefixtures("in_pieces")
def test_windows_are_made_while_parts_are_read_in_order(tmp_path, long):
    """Memory holds a window: what comes long after it is not read yet."""
    path = in_parts(tmp_path, long, 4)
    (tmp_path / "a.record.00003").write_bytes(b"")
    found = apollo.recordings(path, {**logs.packaged("apollo"), "window_s": 20.0})
    assert next(found).name == "a-000"
    assert next(found).progress == pytest.approx(0.9, abs=0.05)
    assert "00003: record: " in refused(list, found)
    in_parts(tmp_path, long[800:] + long[:800], 4)
    line = refused(read, path, window_s=10.0)
    assert re.search(r"timestamp_sec: .*: goes backwards", line)


@pytest.mark.parametrize("silence", [300.0, 86300.0])
@pytest.mark.parametrize("piece", [5.0, 1e9])
def test_a_long_silence_is_stepped_over(tmp_path, monkeypatch, silence, piece):
    """What is held is not looked at once for every second of it."""
    monkeypatch.setattr(messages, "PIECE_S", piece)
    looked_at, recording = [], messages.Drive.recording
    monkeypatch.setattr(
        messages.Drive,
        "recording",
        lambda held, within: looked_at.append(within) or recording(held, within),
    )
    times = [start + 0.1 * k for start in (0.0, silence) for k in range(9)]
    sent = [(LOCALIZATION, t, fixture.localization(t)) for t in times]
    found = read(write(tmp_path / "a.record", sent), window_s=1.0)
    assert [made.name for made in found] == ["a-000", f"a-{silence:.0f}"]
    assert len(looked_at) < 10


def test_rows_held_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(messages, "MAX_ROWS", 100)
    line = refused(read, in_parts(tmp_path, long_drive(8.0), 1))
    assert "more than 100 obstacle states" in line


def test_a_mode_that_was_said_long_ago_is_not_known(tmp_path):
    """Windows that hold no message of the chassis."""
    sent = [(CHASSIS, 0.0, fixture.chassis(0.0, manual=False)), *long_drive(60.0)]
    found = read(write(tmp_path / "a.record.00000", sent), window_s=20.0)
    egos = [one for made in found for one in made.tracks if one.id.startswith("ego")]
    assert len(found) == len(egos) == 3
    assert not any(ego.is_human(ego.t[0], ego.t[-1]) for ego in egos)
