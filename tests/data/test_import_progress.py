"""The bar of an import: it moves inside a long input, and never changes the data."""

import types

from rcirl_jax.data import importing
from rcirl_jax.data.importing import Progress, RecordingScenes
from rcirl_jax.data.quality import QualityReport


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
    return RecordingScenes(
        name=f"{part} {progress}", source="", licence="", rate_hz=10.0, sha256="",
        scenes=scenes, vehicles=[], groups=[], quality={}, input=part,
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
