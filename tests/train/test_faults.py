"""A training disturbed in every way that one process can be: the same bits."""

import contextlib
import json
import os
import shutil
import signal
import time

import pytest

from rcirl_jax.data.importing import import_logs
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.runtime import signals as interrupts
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.train.loop import restore_run
from tests.data.small_logs import CONFIG as IMPORT
from tests.data.small_logs import files_of, write_logs
from tests.helpers.stored import assert_same_bits
from tests.train.worker import CONFIG, trained

STEPS = 6  # 21 rows, batches of 8, two epochs


@pytest.fixture(scope="module")
def dataset(four_shards):
    return open_dataset(four_shards)


class StopError(Exception):
    pass


def saved(dataset, workdir, stop_after=None, each=lambda step: None):
    """The run, saved after every step; cut short after a step if asked."""

    def on_step(step):
        each(step)
        if step == stop_after:
            raise StopError

    if stop_after is None:
        return trained(dataset, workdir, checkpoint_every=1, on_step=on_step)
    with pytest.raises(StopError):
        trained(dataset, workdir, checkpoint_every=1, on_step=on_step)
    return None


@pytest.fixture(scope="module")
def cut_short(dataset, tmp_path_factory):
    """A run folder with checkpoints 3, 4 and 5."""
    folder = tmp_path_factory.mktemp("cut") / "run"
    saved(dataset, folder, stop_after=5)
    return folder


@pytest.fixture
def run(cut_short, tmp_path):
    return shutil.copytree(cut_short, tmp_path / "run")


def steps_of(workdir):
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["step"] for line in lines]


def test_a_run_goes_on_before_a_damaged_checkpoint(dataset, undisturbed, run, capsys):
    """And after a line of its metrics that a kill cut."""
    victim = next((run / "checkpoints" / "5" / "state" / "d").iterdir())
    victim.write_bytes(victim.read_bytes()[:-1])
    metrics = run / "metrics.jsonl"
    metrics.write_bytes(metrics.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"checkpoint 5: .* run the training again"):
        restore_run(run, CONFIG)  # what is exported is never an older state
    result = saved(dataset, run)
    (line,) = [x for x in capsys.readouterr().err.splitlines() if "checkpoint" in x]
    assert "checkpoint 5: state/d/" in line
    assert line.endswith("damaged; the one before it that is whole: 4")
    assert_same_bits(result.state, undisturbed.state)
    assert steps_of(run) == list(range(1, STEPS + 1))
    assert_same_bits(restore_run(run, CONFIG), undisturbed.state)


def test_a_folder_in_use_or_without_a_whole_checkpoint_is_left_alone(dataset, run):
    before = files_of(run)
    with only_one(run), pytest.raises(InputError, match=f"{run}: in use by another"):
        saved(dataset, run)
    assert files_of(run) == before
    for folder in (run / "checkpoints").glob("[0-9]*"):
        (folder / "position" / "metadata").unlink()
    before = files_of(run)
    with pytest.raises(InputError, match=r"expected one that is whole; use another "):
        saved(dataset, run)
    assert files_of(run) == before


def test_told_to_end_it_saves_the_step_it_is_in(
    dataset, undisturbed, tmp_path, monkeypatch
):
    monkeypatch.setattr(interrupts._Heard, "number", None)

    def on_step(step):
        if step == 1:  # heard in the second of an epoch's three
            interrupts._Heard.number = signal.SIGTERM

    with pytest.raises(interrupts.Interrupted):
        trained(dataset, tmp_path, on_step=on_step)
    assert [x.name for x in (tmp_path / "checkpoints").glob("[0-9]*")] == ["2"]
    interrupts._Heard.number = None
    assert_same_bits(saved(dataset, tmp_path).state, undisturbed.state)
    assert steps_of(tmp_path) == list(range(1, STEPS + 1))


class Clock:
    """The time of day, which jumps hours back and days forth when it is told to."""

    JUMPS = (-7200.0, 3 * 86400.0, -400 * 86400.0, 5.0)

    def __init__(self):
        self.real, self.jumps, self.by_s = time.time, 0, 0.0

    def __call__(self):
        return self.real() + self.by_s

    def jump(self):
        self.by_s += self.JUMPS[self.jumps % len(self.JUMPS)]
        self.jumps += 1


def age(folder, by_s):
    """Files as if written then; every second one the other way round."""
    for number, path in enumerate(sorted(folder.rglob("*"))):
        when = time.time() + (by_s if number % 2 else -by_s)
        with contextlib.suppress(FileNotFoundError):  # a save given up still runs
            os.utime(path, (when, when))


def test_the_time_of_day_decides_nothing(dataset, undisturbed, tmp_path, monkeypatch):
    """Orbax gives up a save that took 300 s of it: one line, the same bits again."""
    clock, ends, result = Clock(), [], None
    monkeypatch.setattr(time, "time", clock)
    while result is None and len(ends) <= STEPS:
        try:
            result = saved(dataset, tmp_path, each=lambda _: clock.jump())
        except InputError as error:
            ends.append(str(error))
            age(tmp_path, 86400.0 * (-1) ** len(ends))
    assert ends  # a jump met a save
    assert all("checkpoints: cannot be written: " in line for line in ends)
    assert result is not None, ends
    assert clock.jumps >= STEPS
    assert_same_bits(result.state, undisturbed.state)
    assert steps_of(tmp_path) == list(range(1, STEPS + 1))
    kept = sorted(x.name for x in (tmp_path / "checkpoints").glob("[0-9]*"))
    assert kept == ["4", "5", "6"]  # the newest by their steps
    assert result.seconds >= 0.0


def test_a_dataset_being_written_is_refused_and_left_alone(tmp_path):
    logs = write_logs(tmp_path / "logs", files=2)
    data = tmp_path / "deep" / "d"
    with only_one(data):
        with pytest.raises(InputError, match=r"deep/d: in use by another process"):
            import_logs(logs, data, IMPORT)
        assert [x.name for x in data.iterdir()] == [".lock"]
    # the file of a killed import holds nobody up, and does not stay
    import_logs(logs, data, IMPORT)
    names = sorted(x.name for x in data.iterdir())
    assert names == ["manifest.json", "plans.json", "shards"]
