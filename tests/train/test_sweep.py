"""Sweeps: members are single runs, one compile a group, resume, the choice."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.splits import Resplit, with_validation
from rcirl_jax.errors import InputError
from rcirl_jax.export import sweep
from rcirl_jax.export.loading import open_reward
from rcirl_jax.export.sweep import (
    SweepConfig,
    best,
    member_name,
    open_split,
    run_sweep,
    table,
    train_group,
)
from rcirl_jax.report.charts import sweep_picture
from rcirl_jax.runtime.executors import Processes, Serial
from rcirl_jax.train import sweep as members_sweep
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.sweep import fit, freeze, members_of
from rcirl_jax.units import HORIZON_S
from tests.helpers.stored import rows_of, stored
from tests.train.test_step import SMALL

BASE = TrainConfig(
    batch_size=8, epochs=2, sampler=SMALL, positive="nearest", train_horizon=5.0
)
SCENES = 40
MADE_BY = {"git_commit": "abc"}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Random scenes, one vehicle each, in four groups of which one is the test."""
    folder = tmp_path_factory.mktemp("sweep") / "d"
    rows = rows_of(range(SCENES))
    future = np.full(SCENES, HORIZON_S, np.float32)
    stored(folder, [rows.replace(future_s=future)])
    return folder


def of_shape(hidden, config):
    """The points of one network shape."""
    return [point for point in config.grid if point.hidden == hidden]


def config_of(data, **changes):
    settings = {
        "data": (str(data),), "base": BASE, "hidden_sizes": ((6,), ()), "seeds": 2,
        "leaky_rates": (0.05, 0.3), "learning_rates": (0.003, 0.03), "validation": 0.3,
    }  # fmt: skip
    return SweepConfig(**{**settings, **changes})


@pytest.fixture(scope="module")
def finished(data, tmp_path_factory):
    """(folder, report) of a sweep in this process."""
    folder = tmp_path_factory.mktemp("finished")
    members_sweep._fit.clear_cache()
    return folder, run_sweep(config_of(data), folder, Serial(), MADE_BY)


def untimed(report):
    """A report without what a clock or the process' caches say."""
    kept = json.loads(json.dumps(report))
    del kept["groups"]
    for member in kept["members"].values():
        del member["sha256"]  # of a file that says when it was made
    del kept["made_by"]
    return kept


def test_members_equal_single_runs(data, monkeypatch):
    monkeypatch.setattr(sweep, "MEMBERS_AT_ONCE", 5)
    config = config_of(data)
    parts = list(train_group(of_shape((6,), config), config))
    assert [len(part.members) for part in parts] == [4, 4]
    split = open_split(config)[1]
    made = freeze(split.load("train"), split.indices("train"), BASE)
    for part in parts:
        for number, member in list(enumerate(part.members))[::3]:
            # batches and candidates are the sweep's, whatever the member's seed
            base = dataclasses.replace(member, seed=BASE.seed)
            alone = fit(made, part.normaliser, base, members_of([member]))
            for a, b in zip(
                jax.tree.leaves(part.fitted.params),
                jax.tree.leaves(alone.params),
                strict=True,
            ):
                np.testing.assert_allclose(a[number], b[0], rtol=1e-3, atol=2e-5)
            found, want = part.fitted.loss[number, -1], float(alone.loss[0, -1])
            assert found == pytest.approx(want, 1e-3)
    assert len({float(x) for part in parts for x in part.fitted.loss[:, -1]}) == 8


def test_everything_is_written_and_loads(finished, tmp_path):
    folder, report = finished
    assert json.loads((folder / "sweep.json").read_text()) == report
    config = config_of("d")
    every = [x for point in config.grid for x in config.members(point)]
    assert [*report["members"]] == [*map(member_name, every)]
    assert len(report["members"]) == 16
    assert next(iter(report["members"])) == "h6_a0.05_r0.003_s0"
    for name, member in report["members"].items():
        reward = open_reward(str(folder / "weights" / f"{name}.msgpack"))
        assert reward.sha256 == member["sha256"]
        assert reward.provenance["seed"] == member["seed"]
        assert reward.provenance["git_commit"] == "abc"
        assert reward.loss["leaky_rate"] == member["leaky_rate"]
    chosen = report["chosen"]
    best_file = folder / "weights" / f"{chosen['member']}.msgpack"
    assert (folder / "best.msgpack").read_bytes() == best_file.read_bytes()
    compiles = {name: group["compiles"] for name, group in report["groups"].items()}
    assert compiles == {"6": 1, "linear": 1}
    score = lambda m: report["members"][m]["validation"]["top1_fde"]  # noqa: E731
    known = report["configurations"].items()
    means = {name: np.mean([score(m) for m in x["members"]]) for name, x in known}
    assert min(means, key=means.get) == chosen["configuration"]
    assert f"{chosen['test']['top1_fde']['value']:.3f}" in table(report)
    assert f"warning: {report['warnings'][0]}" in table(report)
    picture = sweep_picture(tmp_path / "sweep.png", report)
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_a_finished_group_is_not_trained_again(data, finished, tmp_path, monkeypatch):
    first, report = finished
    folder = shutil.copytree(first, tmp_path / "again")
    trained = []
    real = sweep.train_group

    def seen(points, config):
        trained.append(points[0].hidden)
        return real(points, config)

    def again():
        trained.clear()
        made = run_sweep(config_of(data), folder, Serial(), MADE_BY)
        assert untimed(made) == untimed(report)
        return [*trained]

    monkeypatch.setattr(sweep, "train_group", seen)
    assert again() == []
    lost = next(m for m in report["members"] if m.startswith("h6_"))
    (folder / "weights" / f"{lost}.msgpack").write_bytes(b"cut short")
    assert again() == [(6,)]
    (folder / "groups" / "6.json").unlink()
    assert again() == [(6,)]


def test_other_settings_or_data_in_the_folder_are_one_line(data, finished):
    folder = finished[0]
    with pytest.raises(InputError, match=r"stages\.json: leaky_rates: \[0\.05, 0\.3"):
        run_sweep(config_of(data, leaky_rates=(0.05,)), folder, Serial(), {})
    longer = dataclasses.replace(BASE, epochs=9)
    with pytest.raises(InputError, match=r"stages\.json: epochs: 2: expected 9 to"):
        run_sweep(config_of(data, base=longer), folder, Serial(), {})


@pytest.mark.slow
@pytest.mark.multiprocess
def test_the_result_does_not_depend_on_the_executor(data, finished, tmp_path):
    run_sweep(config_of(data), tmp_path, Processes(2), MADE_BY)
    there = json.loads((tmp_path / "sweep.json").read_text())
    assert untimed(there) == untimed(finished[1])
    for name in there["members"]:
        files = [f / "weights" / f"{name}.msgpack" for f in (finished[0], tmp_path)]
        a, b = (open_reward(str(file)) for file in files)
        for x, y in zip((*a.kernels, a.gamma), (*b.kernels, b.gamma), strict=True):
            np.testing.assert_array_equal(x, y)


def test_the_choice_never_sees_the_test_split(data, finished, tmp_path, monkeypatch):
    """Other test scenes: the same choice and validation, another test score."""
    real = sweep.open_split

    def fewer_tests(config):
        dataset, split, by = real(config)
        splits = {name: split.indices(name) for name in ("train", "validation")}
        tests = split.indices("test")[::3]
        return dataset, Resplit(dataset, {**splits, "test": tests}), by

    monkeypatch.setattr(sweep, "open_split", fewer_tests)
    other = untimed(run_sweep(config_of(data), tmp_path, Serial(), MADE_BY))
    first = untimed(finished[1])
    assert other["chosen"]["test"] != first["chosen"]["test"]
    for report in (other, first):
        del report["chosen"]["test"], report["chosen"]["member_test"], report["scenes"]
        del report["warnings"]  # of the test split too
    assert other == first


def test_a_refused_step_is_never_chosen():
    assert best({"a": 2.0, "b": 1.0, "c": 1.0}, "top1_fde") == "b"
    assert best({"a": 0.2, "b": 0.1}, "percentile_rank") == "a"
    assert best({"a": float("nan"), "b": 0.1}, "top1_fde") == "b"
    with pytest.raises(InputError, match="NaN or infinity in every configuration"):
        best({}, "top1_fde")


def test_validation_shares_no_vehicle_with_the_fit(data):
    dataset = open_dataset(data)
    split, by = with_validation(dataset, 0.3, 0)
    assert by == "group"
    parts = [split.load(name) for name in ("train", "validation", "test")]
    groups = [set(np.asarray(part.group).tolist()) for part in parts]
    assert not groups[0] & groups[1]
    assert not (groups[0] | groups[1]) & groups[2]
    everything = np.concatenate([split.indices(n) for n in ("train", "validation")])
    np.testing.assert_array_equal(np.sort(everything), dataset.indices("train"))
    np.testing.assert_array_equal(split.indices("test"), dataset.indices("test"))
    again, by = with_validation(dataset, 0.1, 0)
    assert by == "vehicle"
    cars = [set(np.asarray(again.load(n).vehicle)) for n in ("train", "validation")]
    assert not cars[0] & cars[1]
    assert 2 <= len(cars[1]) <= 0.2 * SCENES


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"leaky_rates": (0.05, 0.05)}, "twice: expected distinct values"),
        ({"hidden_sizes": ()}, "hidden_sizes: .*: expected one value or more"),
        ({"validation": 0.9}, "validation: 0.9: expected 0 to 0.5"),
        ({"choose_by": "luck"}, "choose_by: luck: expected one of"),
        (
            {"base": dataclasses.replace(BASE, loss="logistic")},
            "leaky_rates: .* only loss=rank has a leaky rate",
        ),
    ],
)
def test_wrong_settings_are_one_line(changes, message):
    with pytest.raises(InputError, match=message):
        config_of("d", **changes)
