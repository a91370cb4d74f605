"""The bar of an import: it moves inside a long input, and never changes the data."""

import dataclasses
import itertools
import types

import numpy as np
import pytest

from rcirl_jax.data import importing
from rcirl_jax.data.cut import Cut, digest
from rcirl_jax.data.importers import parts, read_part
from rcirl_jax.data.importing import Progress, import_parts
from rcirl_jax.data.parts import Part
from rcirl_jax.data.readers import reading
from rcirl_jax.data.readers.tables import streams
from rcirl_jax.data.scenes.quality import QualityReport
from rcirl_jax.types import Kind, Recording, Track
from tests.data import small_logs
from tests.data.importers import test_csv_stream as long_csv
from tests.data.importers.formats import apollo, l5, nuplan, waymo

# of `recording`, before a recording could say how much of its input is read
DIGEST = "92db9b7575ab6d0465ca8587350f959848a3e729e65b78c27369f84490d3e1cc"


class Clock:
    """A clock that is moved by hand, or by `step` each time it is read."""

    def __init__(self, monkeypatch, step=0.0):
        self.now, self.step = 1000.0, step
        monkeypatch.setattr("tqdm.std.time", self)
        own = types.SimpleNamespace(monotonic=lambda: self.now)
        monkeypatch.setattr(importing, "time", own)

    def __call__(self):
        self.now += self.step
        return self.now


def made(part, progress, scenes=None):
    return Cut(
        name=f"{part} {progress}", source="", licence="", rate_hz=10.0, sha256="",
        scenes=scenes, vehicles=[], groups=[], quality={}, part=part,
        progress=progress,
    )  # fmt: skip


def quality(scenes, **dropped):
    report = QualityReport()
    report.scenes = scenes
    report.dropped.update(dropped)
    return report


def drawn(capsys):
    """What a bar has drawn, one drawing after the other."""
    text = capsys.readouterr().err.replace("\n", "\r")
    return [line.strip() for line in text.split("\r") if line.strip()]


def shares(lines):
    return [int(line.split("%")[0].split(":")[-1]) for line in lines]


def test_time_left_by_the_share_of_one_part(monkeypatch, capsys):
    """A quarter of the first of two parts in ten seconds: seventy are left."""
    clock = Clock(monkeypatch)
    with Progress(2) as progress:
        clock.now += 10.0
        progress.show(made("a", 0.25), quality(2500, off_map=7, no_obstacles=9))
        assert drawn(capsys)[-1] == (
            "import: 12% [00:10<01:10, 2,500 scenes, 250/s, "
            "dropped: no_obstacles 9 off_map 7]"
        )
        clock.now += 30.0
        progress.show(made("a", 1.0), quality(5000))
        assert drawn(capsys)[-1].startswith("import: 50% [00:40<00:40, 5,000 scenes")
        clock.now += 20.0
        progress.show(made("b", 0.5), quality(6000))
        assert drawn(capsys)[-1].startswith("import: 75% [01:00<00:20, 6,000 scenes")
    assert drawn(capsys)[-1].startswith("import: 100% [01:00<00:00, 6,000 scenes")


def test_parts_that_do_not_say_move_the_bar_as_a_whole(monkeypatch, capsys):
    """An import that fails does not show its end."""
    clock = Clock(monkeypatch)
    with pytest.raises(KeyError), Progress(4) as progress:  # noqa: PT012
        for part in "aabbcd":
            clock.now += 1.0
            progress.show(made(part, None), quality(1))
        raise KeyError
    assert shares(drawn(capsys)) == [0, 0, 0, 25, 25, 50, 75, 75]


def test_a_long_csv_moves_the_bar_and_keeps_its_bytes(tmp_path, monkeypatch, capsys):
    """One file of three minutes: both readings are shown, data are the same."""
    path = tmp_path / "log.csv"
    spec = {**long_csv.write(path, long_csv.rows_of(cars=8)), "long_bytes": 1}
    part = Part(format="csv", input=path, spec=spec)
    config = small_logs.CONFIG
    import_parts([part], tmp_path / "plain", config)
    capsys.readouterr()

    monkeypatch.setattr(streams, "READ_BYTES", 2**14)
    monkeypatch.setattr(reading, "DELAY_S", 0.0)
    Clock(monkeypatch, step=1.0)
    import_parts([part], tmp_path / "data", config)
    lines = drawn(capsys)
    first = [line for line in lines if line.startswith("log.csv: read:")]
    assert any(0 < share < 100 for share in shares(first))
    assert all("<" in line and "?" not in line for line in first[2:])
    second = [line for line in lines if line.startswith("import:")]
    assert sorted(shares(second)) == shares(second)
    assert set(shares(second)) == {0, 33, 67, 100}
    assert shares(second)[-1] == 100
    inside = [line for line in second if "import: 67%" in line]
    assert inside
    assert "<?" not in inside[-1]
    written = [small_logs.files_of(tmp_path / name) for name in ("plain", "data")]
    assert written[0] == written[1]


def found(name, path, **changes):
    (part,), spec = parts(name, path)
    return [made.progress for made in read_part(name, part, {**spec, **changes})]


def test_formats_with_long_parts_say_how_much_is_read(tmp_path):
    waymo.write_shards(tmp_path / "waymo", shards=1)
    progress = found("waymo", tmp_path / "waymo")
    assert progress == [pytest.approx(0.5, abs=0.01), 1.0]
    log = nuplan.write(tmp_path / "nuplan").input
    progress = found("nuplan", log, window_s=2.0)
    assert len(progress) > 2
    np.testing.assert_allclose(np.diff([0.0, *progress]), 1.0 / len(progress))
    assert found("l5", l5.write(tmp_path / "l5").input) == [0.5, 1.0]


def test_a_record_shows_how_much_is_read(tmp_path, monkeypatch, capsys):
    """Apollo's drives are one recording each, so the first reading has a bar."""
    monkeypatch.setattr(reading, "DELAY_S", 0.0)
    Clock(monkeypatch, step=1.0)
    found("apollo", apollo.write(tmp_path).input)
    assert any(0 < share < 100 for share in shares(drawn(capsys)))


def test_quick_reading_and_workers_show_no_bar(tmp_path, monkeypatch, capsys):
    path = tmp_path / "log.csv"
    path.write_text("t\n" * 1000)

    def read():
        with reading.reading(path, [path]) as show:
            for _ in itertools.repeat(None, 10):
                show(300)  # more than there is
        return drawn(capsys)

    assert read() == []
    monkeypatch.setattr(reading, "DELAY_S", 0.0)
    clock = Clock(monkeypatch, step=1.0)
    assert max(shares(read())) == 100
    monkeypatch.setattr(reading.multiprocessing, "parent_process", lambda: clock)
    assert read() == []


def test_what_is_read_after_a_recording_is_no_part_of_it():
    t = np.arange(5) * 0.1
    track = Track(
        id="1", kind=Kind.VEHICLE, length=4.5, width=1.8,
        t=t, x=10.0 * t, y=0.0 * t, heading=0.0 * t, speed=0.0 * t + 10.0,
    )  # fmt: skip
    known = {"source": "b", "licence": "c", "rate_hz": 10.0, "notes": ("note",)}
    recording = Recording(name="a", **known, tracks=(track,), lanes=())
    assert digest(recording) == DIGEST
    assert digest(dataclasses.replace(recording, progress=0.3)) == DIGEST
    by_machine = dataclasses.replace(track, automated=((0.0, 1.0),))
    for change in ({"rate_hz": 5.0}, {"tracks": (by_machine,)}):
        assert digest(dataclasses.replace(recording, **change)) != DIGEST
