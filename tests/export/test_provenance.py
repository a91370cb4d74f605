"""What a file says of its making may be anything: it is checked before it is used."""

import dataclasses

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export import pack
from rcirl_jax.export.from_run import data_weights_of, datasets_of
from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.reader import load_weights
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.units import TIMES_S
from tests.helpers import weights_files
from tests.helpers.weights_files import SPECS


def with_provenance(tmp_path, monkeypatch, **entries):
    """A file that every main accepts, but for these entries of its provenance."""
    made = {**weights_files.provenance(), **entries}
    monkeypatch.setattr(weights_files, "provenance", lambda: made)
    return weights_files.random_weights(tmp_path / "w.msgpack")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", True), ("flags", "x"), ("mode", 3), ("dataset_sha256", {}),
    ],
)  # fmt: skip
def test_entries_of_other_types_are_one_line(tmp_path, monkeypatch, name, value):
    path = with_provenance(tmp_path, monkeypatch, **{name: value})
    with pytest.raises(
        InputError, match=rf"w\.msgpack: provenance\.{name}: .*expected"
    ):
        open_reward(str(path))


def test_times_that_no_trajectory_here_has(tmp_path):
    """The file itself is whole: only what ranks or drives here refuses it."""
    times = TIMES_S[:10]
    made = weights_files.example_weights(features=len(SPECS), times=len(times))
    made = weights_files.of_the_preset(made, times=times.astype("f4"))
    path = tmp_path / "w.msgpack"
    path.write_bytes(pack(made, *weights_files.example_samples(made)))
    assert load_weights(path).times.size == len(times)
    with pytest.raises(
        InputError, match=r"w\.msgpack: times: another grid: expected 8 i / 17 s"
    ):
        open_reward(str(path))


def run_on(folder, data, **flags):
    """A run's folder whose flags name these data."""
    config = dataclasses.asdict(TrainConfig())
    body = {"config": config, "flags": {"data": data, **flags}}
    write_json(folder / "run.json", body)
    return folder


@pytest.mark.parametrize("found", [[], "a\0b"])
def test_names_that_no_dataset_can_have(tmp_path, found):
    with pytest.raises(
        InputError, match=r"run\.json: flags\.data: .*expected a dataset"
    ):
        datasets_of(run_on(tmp_path, found))


def test_a_run_is_exported_with_its_own_shares_of_the_data(tmp_path):
    """They are part of the hash of joined datasets, which the export compares."""
    assert data_weights_of(run_on(tmp_path, ["a", "b"])) == "equal"
    shared = run_on(tmp_path, ["a", "b"], data_weights="scenes")
    assert data_weights_of(shared) == "scenes"
