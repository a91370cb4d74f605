"""Every figure and table of the paper by its command, small."""

import json
import math

import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.simulation.rows import BASELINES
from rcirl_jax.simulation.suite import family_names
from rcirl_jax.train.state import PAPER_OPTIMIZERS
from tests.helpers.commands import succeeded
from tests.helpers.weights_files import random_weights

# of one mould, `experiments/paper/common.py`: one of them in each run of the tests
SLOW = ("artefact_audit", "one_frame", "optimisers", "rank_against_gan")
RANKED = (
    "discount_factors", *(pytest.param(x, marks=pytest.mark.slow) for x in SLOW)
)  # fmt: skip
# shared flags as used under --quick; those with a value of their own; those not read
SHARED = {"seeds": 2, "epochs": 2, "horizon": 5.0, "positive": "nearest"}
SHARED["recipe"] = "tuned"
OWN = dict.fromkeys(("artefact_audit", "discount_factors", "one_frame"), 8.0)  # horizon
UNREAD = {"artefact_audit": "positive", "one_frame": "seeds"}


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper") / "synthetic"
    config = ImportConfig(format="synthetic", collect=CollectConfig(stride_s=120.0))
    import_logs(read_recordings("synthetic", None), folder, config)
    return folder


def made(name, folder, *flags):
    """(what a figure's command wrote as JSON, what it said)."""
    flags = ("--quick", f"--output={folder}", *flags)
    done = succeeded(f"experiments.paper.{name}", *flags)
    file = folder / f"{name}.json"
    return json.loads(file.read_text()) if file.exists() else None, done.stdout


def numbers(item):
    if isinstance(item, dict):
        for value in item.values():
            yield from numbers(value)
    elif isinstance(item, list):
        for value in item:
            yield from numbers(value)
    elif isinstance(item, float):
        yield item


def shared_flags(body):
    """The shared flags that the file records."""
    recorded = body["made_by"]["flags"]
    return {name: recorded[name] for name in SHARED if name in recorded}


def test_background_shift(tmp_path):
    body, _ = made("background_shift", tmp_path)
    assert all(math.isfinite(x) for x in numbers(body))
    angles = body["example"]["angle_to_truth_deg"]
    assert angles["conditional, logistic"]["mean"] < angles["pooled"]["mean"]
    still = body["example_without_shift"]["angle_to_truth_deg"]
    assert angles["pooled"]["low"] > 30.0 > 10.0 > still["pooled"]["high"]
    assert max(angles[x]["high"] for x in angles if "conditional" in x) < 10.0
    assert body["made_by"]["flags"]["quick"] is True
    assert (tmp_path / "background_shift.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize("name", RANKED)
def test_writes_numbers_and_a_picture(name, dataset, tmp_path):
    body, _ = made(name, tmp_path, f"--data={dataset}")
    found = list(numbers(body))
    assert found
    assert all(math.isfinite(x) for x in found)
    assert body["quick"] is True
    assert body["made_by"]["versions"]
    assert body["made_by"]["recipe"]["batch_size"] == 64
    used = {**SHARED, "horizon": OWN.get(name, SHARED["horizon"])}
    used.pop(UNREAD.get(name), None)
    assert shared_flags(body) == used
    assert body["made_by"]["data_hash"]
    if name == "optimisers":
        rows = body["ranking"]["rows"]
        found = {rows[f"rank, {x}"]["top1_fde"]["value"] for x in PAPER_OPTIMIZERS}
        assert len(found) == 3
        for one in body["step_sizes"].values():
            tried = {float(rate): far for rate, far in one["distance"].items()}
            assert tried[one["chosen"]] == min(tried.values())
    assert (tmp_path / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


def test_the_example_frame_says_why(dataset, tmp_path):
    weights = random_weights(tmp_path / "random.msgpack")
    flags = (f"--data={dataset}", f"--weights={weights}", "--row=0")
    body, said = made("one_frame", tmp_path, *flags)
    assert "value of the chosen minus the human's, by feature: " in said
    apart = body["chosen_value"] - body["human_value"]
    assert sum(body["reasons"].values()) == pytest.approx(apart, rel=0.02, abs=1e-4)
    assert body["row"] == 0
    assert shared_flags(body) == {}  # nothing was trained
    assert body["made_by"]["weights_sha256"] == {str(weights): body["weights_sha256"]}


@pytest.mark.slow
def test_left_out_site(tmp_path):
    body, _ = made("left_out_site", tmp_path, "--recipe=quick")
    hashes = {site["data_hash"] for site in body["sites"].values()}
    assert len(hashes) == len(body["sites"]) == 2
    for site in body["sites"].values():
        value = lambda row, of=site["rows"]: of[row]["top1_fde"]["value"]  # noqa: E731
        elsewhere, everywhere = value("without the site"), value("all sites")
        assert value("oracle") < elsewhere != everywhere
        assert site["runs"]["without the site"] == site["runs"]["all sites"] == 2
        (apart,) = [
            one["difference"]["mean"]
            for one in site["comparisons"]
            if (one["row"], one["reference"]) == ("without the site", "all sites")
            and one["metric"] == "top1_fde"
        ]
        assert apart == pytest.approx(elsewhere - everywhere, abs=1e-6)
    assert len(body["made_by"]["weights_sha256"]) == 2 * 3
    assert shared_flags(body) == {"seeds": 2, "horizon": 5.0, "recipe": "quick"}


@pytest.mark.slow
def test_table2(dataset, tmp_path):
    """From people to the table: every row over every family."""
    made("table2", tmp_path, f"--data={dataset}")
    suite = json.loads((tmp_path / "suite" / "suite.json").read_text())
    losses, forms = ("rank", "gan", "listwise"), ("alone", "anchored")
    learned = {f"{loss} {form}" for loss in losses for form in forms}
    assert set(suite["report"]["rows"]) == {*learned, *BASELINES}
    assert suite["report"]["cases"] == len(family_names())
    assert len(suite["made_by"]["weights_sha256"]) == len(learned)
    assert shared_flags(suite) == {k: v for k, v in SHARED.items() if k != "horizon"}
    for folder in ("suite", "dp"):
        assert (tmp_path / folder / "table.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_robustness(tmp_path):
    weights = random_weights(tmp_path / "random.msgpack")
    body, _ = made("robustness", tmp_path, f"--weights={weights}")
    assert set(body["optimality"]) == {"rank", "DP"}
    assert set(body["robustness"]) == {"rank", "DP", "hand-set"}
    frames = {row["gap"]["frames"] for row in body["optimality"].values()}
    assert len(frames) == 1  # all rows on the same frames
    assert set(body["made_by"]["weights_sha256"]) == {str(weights)}
    for name in ("optimality", "robustness"):
        assert (tmp_path / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_human_likeness_over_folds(dataset, tmp_path):
    succeeded(
        "rcirl_jax", "human-likeness", f"--data={dataset}", f"--output={tmp_path}",
        "--learners=RC-IRL rank,GAN", "--seeds=2", "--epochs=1", "--tuned=1",
        "--tuned_long=5", "--folds=2",
    )  # fmt: skip
    body = json.loads((tmp_path / "ranking.json").read_text())
    scenes = open_dataset(dataset).indices(None).size
    assert sum(part["test"] for part in body["parts"]) == scenes
    assert body["counts"]["scenes"] > 0.9 * scenes  # those recorded for 5 s
    assert body["runs"]["GAN"] == 2
    for row in ("hand-set, tuned", "hand-set, tuned long", "IDM, tuned"):
        assert body["runs"][row] == 1
        assert all(len(part[row]) == 1 for part in body["tuned"])
    assert body["made_by"]["data_hash"] == open_dataset(dataset).hash
    rows = (tmp_path / "table.md").read_text().splitlines()
    assert {line.count("|") for line in rows} == {11}
    assert (tmp_path / "ranking.png").read_bytes()[:4] == b"\x89PNG"
