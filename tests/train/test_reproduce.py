"""A weights file trained again from its own provenance."""

import dataclasses
import functools

import jax
import msgpack
import numpy as np
import pytest

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.errors import InputError
from rcirl_jax.export import FeatureSpec, RewardWeights, load_weights, save
from rcirl_jax.export.reproduce import (
    Reproduction,
    compare,
    settings_of,
    setup_warnings,
    train_again,
)
from rcirl_jax.units import HORIZON_S
from tests.data.store.test_dataset import finish_fields, lineage
from tests.helpers.commands import fresh
from tests.helpers.scenes import batch, demonstration

COUNT = 12  # scenes, of which nine train
# The compiler as users have it: flags are noted, so there is one, with its usual value
command = functools.partial(fresh, compiler="--xla_cpu_enable_fast_math=false")


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """(weights file, dataset) of a small run by its commands."""
    folder = tmp_path_factory.mktemp("reproduce")
    rows = jax.tree.map(np.asarray, batch([demonstration(i) for i in range(COUNT)]))
    rows = rows.replace(future_s=np.full(COUNT, HORIZON_S, np.float32))
    writer = DatasetWriter(folder / "d")
    writer.write_shard(0, rows, lineage(0))
    writer.finish(finish_fields())
    flags = ("--epochs=2", "--batch_size=4", "--hidden_size=4", "--learning_rate=0.05")
    run = f"--workdir={folder / 'run'}"
    done = command("experiments.train", f"--data={folder / 'd'}", run, *flags)
    assert done.returncode == 0, done.stderr
    done = command("experiments.export_weights", run)
    assert done.returncode == 0, done.stderr
    return folder / "run" / "weights.msgpack", open_dataset(folder / "d")


def changed(path, target, *, tensor=None, **provenance):
    """The file with something else in its provenance, or a kernel that has moved."""
    found = load_weights(path)
    body = msgpack.unpackb(msgpack.unpackb(path.read_bytes())["body"])
    array = lambda box: np.frombuffer(box["data"], "<f4").reshape(box["shape"])  # noqa: E731
    x, valid = (array(body["samples"][name]) for name in ("features", "valid"))
    kernels = list(found.kernels)
    if tensor is not None:
        kernels[tensor] = kernels[tensor] * np.float32(1.001)
    moved = dataclasses.replace(found, kernels=tuple(kernels))
    names = {f.name for f in dataclasses.fields(RewardWeights)}
    fields = {k: v for k, v in vars(moved).items() if k in names}
    specs = zip(found.names, found.units, found.none_values, strict=True)
    weights = RewardWeights(
        **{**fields, "provenance": {**found.provenance, **provenance}},
        features=tuple(
            FeatureSpec(name=n, unit=u, none_value=none) for n, u, none in specs
        ),
    )
    return save(target, weights, x, valid, moved.value(x, valid))


def test_the_same_machine_gives_the_same_bits(made, tmp_path):
    done = command(
        "experiments.reproduce", f"--weights={made[0]}", f"--output={tmp_path / 'a'}"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "reproduced: bit for bit" in done.stdout
    assert "warning: versions" not in done.stdout
    ours, theirs = load_weights(made[0]), load_weights(tmp_path / "a/weights.msgpack")
    assert max(compare(ours, theirs).values()) == 0.0
    assert theirs.provenance["config"] == ours.provenance["config"]
    done = command(
        "experiments.reproduce", f"--weights={made[0]}", f"--output={tmp_path / 'a'}"
    )
    assert done.returncode == 2
    assert "run: exists: expected a folder without a run" in done.stderr


def test_a_changed_setting_is_not_reproduced(made, tmp_path):
    config = {**load_weights(made[0]).provenance["config"], "learning_rate": 0.3}
    changed(made[0], tmp_path / "w.msgpack", config=config)
    done = command(
        "experiments.reproduce",
        f"--weights={tmp_path / 'w.msgpack'}",
        f"--output={tmp_path / 'a'}",
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "not reproduced: " in done.stdout
    assert " differs by " in done.stdout


def test_a_moved_tensor_is_named(made, tmp_path):
    before = load_weights(made[0])
    after = changed(made[0], tmp_path / "w.msgpack", tensor=1)
    differences = compare(before, after)
    assert {name for name, most in differences.items() if most} == {"layers[1].kernel"}
    same = Reproduction(differences=differences, warnings=(), tolerance=0.01)
    assert not same.reproduced
    assert same.worst == ("layers[1].kernel", pytest.approx(0.001, rel=1e-3))
    assert same.text().startswith("not reproduced: layers[1].kernel differs by 0.001 ")
    other = dataclasses.replace(same, warnings=("versions.jax: 1, now 2",))
    assert other.reproduced
    assert not dataclasses.replace(other, tolerance=1e-4).reproduced


def test_another_value_for_nothing_there_is_named(made):
    before = load_weights(made[0])
    moved = tuple(none + 1.0 for none in before.none_values)
    after = dataclasses.replace(before, none_values=moved)
    differences = compare(before, after)
    assert {name for name, most in differences.items() if most} == {"none_values"}


def test_another_shape_or_loss_is_no_reproduction(made, tmp_path):
    before = load_weights(made[0])
    wide = dataclasses.replace(before, gamma=np.ones(3, np.float32))
    assert compare(before, wide)["gamma"] == np.inf
    loss = dataclasses.replace(before, loss={"name": "gan", "leaky_rate": None})
    with pytest.raises(InputError, match=r"loss: .*gan.*: expected .*listwise"):
        compare(before, loss)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("flags", {}, "provenance.flags: missing: expected a file that"),
        ("config", None, "provenance.config: missing: expected a file that"),
        ("steps", None, "provenance.steps: missing: expected a file that"),
        ("steps", 5, "provenance.steps: 5: expected 6, a run that was trained to its"),
        ("config", {"loss": "rank"}, "provenance.config: 'reward': expected settings"),
        ("dataset_sha256", "0" * 64, "provenance.dataset_sha256: 0000"),
        (
            "config",
            {"reward": {"hidden": [2**30]}, "sampler": {}},
            "provenance.config.reward.hidden: [1073741824]: expected [4], the layers",
        ),
    ],
)
def test_what_cannot_be_trained_again_is_one_line(made, tmp_path, name, value, message):
    path = tmp_path / "w.msgpack"
    reward = changed(made[0], path, **{name: value})
    with pytest.raises(InputError) as caught:
        train_again(reward, made[1], tmp_path / "out", {})
    assert str(caught.value).startswith(f"{path}: {message}")
    assert not (tmp_path / "out").exists()


def test_a_place_elsewhere_is_not_opened(made, tmp_path):
    path, folder = tmp_path / "w.msgpack", tmp_path / "again"
    changed(made[0], path, flags={"data": "gs://bucket/d"})
    done = command("experiments.reproduce", f"--weights={path}", f"--output={folder}")
    assert done.returncode == 2
    assert f"{path}: provenance.flags.data: gs://bucket/d: expected a fo" in done.stderr
    assert not folder.exists()


def test_a_file_says_how_it_was_made(made):
    reward, data = made[0], made[1]
    found = load_weights(reward).provenance
    assert settings_of(load_weights(reward), data).learning_rate == 0.05
    assert found["flags"]["learning_rate"] == 0.05
    assert (found["seed"], found["steps"], found["devices"]) == (0, 6, 1)
    assert found["dataset_sha256"] == data.hash
    for name in ("machine", "cpu", "cores", "device", "git_commit", "versions"):
        assert name in found
    assert {"jax", "jaxlib", "rcirl-jax", "python"} <= set(found["versions"])


def test_differences_of_the_setup_are_named():
    before = {"versions": {"jax": "0.10.2", "numpy": "2.0"}, "git_commit": "a+"}
    now = {"versions": {"jax": "0.11.0", "numpy": "2.0"}, "git_commit": "b"}
    assert setup_warnings(before, now) == (
        "versions.jax: 0.10.2, now 0.11.0",
        "git_commit: a+, now b",
        "git_commit: of a checkout with changes, which are not recorded",
    )
    assert setup_warnings(now, now) == ()


def test_what_rounds_numbers_otherwise_is_part_of_the_setup(made):
    """Flags of the compiler, and code that no commit names."""
    found = load_weights(made[0]).provenance
    assert "XLA_FLAGS" in found["environment"]  # as `command` sets them
    assert len(found["code_sha256"]) == 64
    others = {**found, "environment": {}, "code_sha256": "0"}
    said = setup_warnings(found, others)
    assert any(line.startswith("environment.XLA_FLAGS: --xla") for line in said)
    assert any(line.startswith("code_sha256: ") for line in said)
    # a file of a version that did not note them
    old = {k: v for k, v in found.items() if k not in ("environment", "code_sha256")}
    assert setup_warnings(old, found) == setup_warnings(found, found)
