"""Checkpoints harmed on disk: found, named, passed over; never half-believed."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.train.checkpoint import (
    DAMAGED,
    DIGESTS,
    KEEP_LATEST,
    MARKS,
    Checkpoints,
)
from rcirl_jax.train.loop import blank_state
from rcirl_jax.train.state import TrainConfig
from tests.data.small_logs import files_of
from tests.helpers.stored import assert_same_bits

CONFIG = TrainConfig()


@pytest.fixture(scope="module")
def state():
    return blank_state(CONFIG)


def at(state, step):
    """Another state at every step, to tell them apart."""
    params = {**state.params, "gamma": state.params["gamma"] + step}
    return state.replace(step=jnp.asarray(step, state.step.dtype), params=params)


@pytest.fixture(scope="module")
def saved(state, tmp_path_factory):
    """Checkpoints 2, 3, 4."""
    folder = tmp_path_factory.mktemp("saved") / "checkpoints"
    checkpoints = Checkpoints(folder)
    for step in (1, 2, 3, 4):
        checkpoints.save(at(state, step), {"epoch": 0, "index": step})
    checkpoints.close()
    assert sorted(x.name for x in folder.iterdir()) == ["2", "3", "4"]
    assert KEEP_LATEST == 3
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    """A copy, to be harmed."""
    return shutil.copytree(saved, tmp_path / "c")


def restored(folder, state):
    """(step, position, lines) of a run that goes on there."""
    checkpoints = Checkpoints(folder)
    found, position = checkpoints.restore(state)
    checkpoints.close()
    step = int(found.step)
    assert_same_bits(found, at(state, step))
    assert position == {"epoch": 0, "index": step}
    return step, checkpoints.passed_over


def flip(path, rng):
    raw = bytearray(path.read_bytes())
    bit = int(rng.integers(8 * len(raw)))
    raw[bit // 8] ^= 1 << bit % 8
    path.write_bytes(raw)


def cut(path, rng):
    raw = path.read_bytes()
    path.write_bytes(raw[: int(rng.integers(len(raw)))])


HARMS = (flip, cut, lambda path, rng: path.unlink())


def test_harm_to_any_file_is_found_and_named(saved, state, tmp_path):
    """Each file in one of three ways."""
    assert restored(saved, state) == (4, [])
    rng = np.random.default_rng(0)
    for number, name in enumerate(sorted(files_of(saved / "4"))):
        folder = shutil.copytree(saved, tmp_path / str(number))
        HARMS[number % 3](folder / "4" / name, rng)
        if name.name in MARKS:  # changes nothing
            assert restored(folder, state) == (4, []), name
            continue
        step, (line,) = restored(folder, state)
        assert step == 3, name
        assert line.startswith(f"{folder}: checkpoint 4: {name}: "), line
        assert line.endswith("the one before it that is whole: 3")
        assert (folder / f"4{DAMAGED}").is_dir()  # kept to look at
        assert not (folder / "4").exists()


def test_steps_after_a_damaged_one_are_saved_again(folder, state):
    """Twice: what was put aside before makes room. Also after a file too many."""
    for harm in (DIGESTS, "state/more"):
        (folder / "4" / harm).write_text("{}")
        checkpoints = Checkpoints(folder)
        assert checkpoints.latest_step == 3
        checkpoints.save(at(state, 4), {"epoch": 0, "index": 4})
        checkpoints.close()
        assert restored(folder, state) == (4, [])


def test_who_only_reads_leaves_everything_as_it_is(folder, state, tmp_path):
    """Also what a training beside it is just writing."""
    half = folder / "5.orbax-checkpoint-tmp-7" / "state"
    half.mkdir(parents=True)
    (half / "d").write_text("half")
    (folder / "4" / DIGESTS).unlink()
    before = files_of(folder)
    checkpoints = Checkpoints(folder, read_only=True)
    assert int(checkpoints.restore(state)[0].step) == 3
    checkpoints.close()
    assert files_of(folder) == before
    assert Checkpoints(tmp_path / "none", read_only=True).latest_step is None
    assert not (tmp_path / "none").exists()
