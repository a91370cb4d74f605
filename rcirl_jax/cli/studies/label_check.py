"""Are the automatic labels right? Precision and recall against known truth.

    rcirl label-check --traffic=4 --noise=ngsim,none --output=DIR

--traffic simulated recordings of every entry of data_specs/sources/synthetic.toml,
whose drivers' own state is the truth, are labelled and compared; position noise as in
NGSIM, or none. --workers and --executor spread the recordings.
--platoons simulated single files of cars have no overtaking, nudge or lane change.
--judged=FOLDER compares with verdicts of a person on recorded scenes
(data_specs/labels/judged_scenes.json); the folder holds the recordings. --sheets=DIR
draws these scenes without their labels, to be judged again.

Writes labels.json and labels.png. Four recordings of each entry take some
minutes per noise. Expected: above 95 % everywhere. Needs the extra [report].
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.flags.common import provenance
from rcirl_jax.cli.flags.executor import executor
from rcirl_jax.evaluation.labels.judged import (
    judged_scenes,
    measure_judged,
    read_verdicts,
)
from rcirl_jax.evaluation.labels.platoons import measure_platoons
from rcirl_jax.evaluation.labels.scores import format_labels, format_scores
from rcirl_jax.evaluation.labels.traffic import measure_traffic
from rcirl_jax.runtime.atomic_files import write_json

USUAL = (
    *("output", "traffic", "noise", "platoons", "judged", "sheets", "seed"),
    *("quick", "workers"),
)
_TRAFFIC = flags.DEFINE_integer(
    "traffic", 4, "recordings of each simulated road, 1 or more"
)
_NOISE = flags.DEFINE_list(
    "noise", ["ngsim", "none"], "of positions, one run each: none, white, ngsim, rough"
)
_PLATOONS = flags.DEFINE_integer(
    "platoons", 0, "simulated single files of cars; 0: none", 0
)
_JUDGED = flags.DEFINE_string(
    "judged", None, "folder of the recordings whose scenes a person has judged"
)
_SHEETS = flags.DEFINE_string("sheets", None, "folder for pictures of judged scenes")
_SEED = flags.DEFINE_integer("seed", 0, "of the traffic and the noise")
_OUTPUT = flags.DEFINE_string("output", "out/label_check", "folder to write")
_QUICK = flags.DEFINE_bool(
    "quick", False, "one recording of each road, the first noise: to try it out"
)


def main() -> None:
    """Flags -> tables, labels.json, labels.png."""
    from rcirl_jax.report.data.label_picture import label_chart

    body, tables = {}, {}
    noises = _NOISE.value[:1] if _QUICK.value else _NOISE.value
    count = 1 if _QUICK.value else _TRAFFIC.value
    places = executor()
    for noise in noises:
        report = measure_traffic(count, noise, _SEED.value, executor=places)
        print(f"{format_labels(report)}\n")
        body[noise] = report.as_dict()
        tables[f"noise {noise}, decisions"] = report.decisions
        tables[f"noise {noise}, tags"] = report.tags
    if _PLATOONS.value:
        body["platoons"] = measure_platoons(_PLATOONS.value, _SEED.value)
        print(f"platoons: {body['platoons']}\n")
    if _JUDGED.value:
        body["judged"] = _judged(Path(_JUDGED.value), tables)
    folder = Path(_OUTPUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    picture = label_chart(folder / "labels.png", tables)
    body["made_by"] = provenance()
    write_json(folder / "labels.json", body)
    print(f"written: {folder}/labels.json, {picture.name}")


def _judged(data: Path, tables: dict) -> dict:
    """Scores of the judged scenes, JSON-ready; shown and added to the tables."""
    found = judged_scenes(read_verdicts(), data)
    scores = measure_judged(found)
    if _SHEETS.value:
        from rcirl_jax.report.data.judging_sheet import draw_sheets

        print(f"{draw_sheets(Path(_SHEETS.value), found)} sheets in {_SHEETS.value}")
    for batch, found in scores.items():
        print("\n".join(format_scores(f"judged, {batch}", found)), "\n")
    tables["judged scenes"] = scores["all"]
    return {batch: [one.as_dict() for one in found] for batch, found in scores.items()}
