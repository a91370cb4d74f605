"""The loop by its command: once, and again."""

import html
import json

import pytest

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.runtime.pipeline import only_one
from tests.helpers.commands import fresh, refused, succeeded

SMALL = (
    "--synthetic", "--recipe=quick", "--stride=60", "--epochs=1", "--drives=6",
    "--suite=free_cruise,stopped_lead", "--cases=15", "--duration=2",
)  # fmt: skip
DEMONSTRATED = """
[train]
epochs = 1
loss = "listwise"
positive = "nearest"
[simulated_demonstrations]
expert = "own cost"
cases = 1
duration_s = 20.0
stride_s = 4.0
[prior_cost]
gain = 1.1
"""


def kept(done):
    """Stage -> whether it was kept."""
    lines = [x for x in done.stdout.splitlines() if x.startswith("[")]
    return {x[1 : x.index("]")]: x.endswith("kept") for x in lines}


@pytest.mark.multiprocess
def test_a_small_loop(tmp_path):
    run, own = tmp_path / "run", tmp_path / "own.toml"
    own.write_text(DEMONSTRATED)
    flags = (f"--output={run}", *SMALL, f"--recipe={own}")
    done = succeeded("rcirl_jax", "autotune", *flags)
    begun = [x for x in done.stdout.splitlines() if x.startswith("stage ")]
    names = ("import", "demonstrate", "train", "rank", "simulate", "gate", "report")
    for number, (line, name) in enumerate(zip(begun, names, strict=True), 1):
        assert line.startswith(f"stage {number} of 7: {name}; ")
    ending = done.stdout.split("\n\n")[-1].splitlines()
    assert ending[0].startswith("verdict: ")
    assert f"report to open: {run}/report.html" in ending
    assert ending[-1].startswith(f"next: rcirl replay --weights={run}/weights.msgpack ")
    stages = [
        "import 0", "demonstrate", "prior cost", "train 0", "export", "tune",
        "rank predicted", "rank recorded", "simulate", "likeness", "gate", "dial",
        "decided", "report",
    ]  # fmt: skip
    assert kept(done) == dict.fromkeys(stages, False)
    verdict = json.loads((run / "verdict.json").read_text())
    assert verdict["cases"] == 30
    assert verdict["files"]["incumbent"] == "hand-set"
    page = (run / "report.html").read_text()
    assert verdict["decision"] in page
    assert f'"recipe": "{own}"' in html.unescape(page)
    assert verdict["training_runs"] == 1
    assert verdict["part"].startswith("30 cases, 4,110 of the full suite's left out")
    assert "recorded human" in page  # drives beside the others
    assert "features without effect" in done.stdout
    likeness = json.loads((run / "likeness.json").read_text())
    rows = {"candidate", "hand-set", "IDM", "IDM, tuned", "constant V", "+velocity"}
    others = {"random weights", "recorded human"}
    assert rows | others == set(likeness["rows"])
    table = (run / "suite" / "table.txt").read_text()
    assert all(name in table for name in rows)
    dial = json.loads((run / "dial.json").read_text())
    assert (dial["own_cost"], dial["cases"], dial["drives"]) == ("hand-set", 4, 6)
    settings = {one["dial"]: one["measures"]["distance"] for one in dial["settings"]}
    assert list(settings) == [0.0, 0.5, 1.0, 2.0]
    for setting, name in ((0.0, "hand-set"), (1.0, "candidate")):
        mean = likeness["rows"][name]["distance_m"]["mean"]
        assert settings[setting]["value"] == pytest.approx(mean)
    turned = (run / "dials" / "0.5.msgpack").read_bytes()
    flags_of_dial = ("--dial=0.5", f"--output={tmp_path / 'turned'}")
    succeeded("rcirl_jax", "export", f"--weights={run}/weights.msgpack", *flags_of_dial)
    assert (tmp_path / "turned").read_bytes() == turned
    kinds = {check["kind"] for check in verdict["checks"]}
    assert {"safety", "trivial baselines", "likeness", "gain"} <= kinds
    assert verdict["warnings"]["training"][0].startswith("training: ")
    assert verdict["against"]
    shares = json.loads((run / "decided.json").read_text())
    assert shares["sites"]["all"]["moments"] > 0
    noted = json.loads((run / "stages.json").read_text())["stages"]
    assert list(noted) == stages
    known = {"git_commit", "code_sha256", "versions", "flags"}
    assert all(set(record["made_by"]) == known for record in noted.values())

    (run / "report.html").unlink()
    copy = tmp_path / "copy.html"
    drawn = succeeded("rcirl_jax", "report", f"--run={run}", f"--output={copy}")
    assert kept(drawn) == {"report": False}
    assert verdict["decision"] in (run / "report.html").read_text()
    assert copy.read_bytes() == (run / "report.html").read_bytes()
    assert 'id="training-heading"' in page
    assert all(kept(fresh("rcirl_jax", "autotune", *flags)).values())
    dataset = open_dataset(*run.glob("dataset-*"))
    assert dataset.facts()["data_hash"] == dataset.hash
    assert "flags" in dataset.facts()["made_by"]


@pytest.mark.multiprocess
def test_a_run_in_use_is_one_line(tmp_path):
    run = tmp_path / "run"
    with only_one(run):
        line = refused("rcirl_jax", "autotune", f"--output={run}", *SMALL)
    assert line.startswith(f"error: {run}: in use by another process: ")
    assert not run.exists()
