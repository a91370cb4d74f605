"""Are the automatic labels right? Precision and recall against known truth.

    python -m experiments.label_check --traffic=4 --noise=ngsim,none --output=DIR
    python -m experiments.label_check --format=commonroad --input=DIR --output=DIR

Without --input: --traffic simulated recordings of every entry of
data_specs/sources/synthetic.toml, whose drivers' own state is the truth, are labelled
and compared; position noise as in NGSIM, or none.
With --input (any recorded format): the written cycle of every signal is tested
against crossings and stands, and the stop labels against observed stands, with
the signals that an import trusts of itself, those it uses when told these phases
(`import_logs --signals=pooled`), and all of them. With --data the labels
stored in a dataset are compared with today's rules. --workers and --executor
spread the recordings and the logs.

Writes labels.json and labels.png. Four recordings of each entry take some
minutes per noise, the urban CommonRoad files three on two cores.
Expected: above 95 % everywhere.
"""

from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from experiments.executor import executor
from rcirl_jax.data.importers import IMPORTERS
from rcirl_jax.data.parts import parts_of
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.labels.logs import check_logs
from rcirl_jax.evaluation.labels.scores import format_labels, format_scores
from rcirl_jax.evaluation.labels.signals import format_phases
from rcirl_jax.evaluation.labels.stops import compare_stored, format_stops
from rcirl_jax.evaluation.labels.traffic import measure_traffic
from rcirl_jax.report.data.label_picture import label_chart
from rcirl_jax.runtime.atomic_files import write_json

_TRAFFIC = flags.DEFINE_integer("traffic", 4, "recordings of each road simulated")
_NOISE = flags.DEFINE_list("noise", ["ngsim", "none"], "none, white, ngsim, rough")
_SEED = flags.DEFINE_integer("seed", 0, "of the traffic and the noise")
_OUTPUT = flags.DEFINE_string("output", "out/label_check", "folder to write")
_DATA = flags.DEFINE_string("data", None, "dataset whose stored labels are compared")
_FORMAT = flags.DEFINE_enum("format", "commonroad", sorted(IMPORTERS), "of --input")
_INPUT = flags.DEFINE_string("input", None, "recorded file or folder")
_SOURCE = flags.DEFINE_string("source", None, "TOML of columns and units of --input")
_QUICK = flags.DEFINE_bool("quick", False, "one recording of each road, one noise")


def main() -> None:
    """Flags -> tables, labels.json, labels.png."""
    body, tables, parts, data = {}, {}, [], {}
    if _INPUT.value:
        source = Path(_SOURCE.value) if _SOURCE.value else None
        parts = parts_of(_FORMAT.value, Path(_INPUT.value), source)
        logs = check_logs(parts, executor=executor())
        print(format_phases(logs.phases))
        body["phases"] = [check.as_dict() for check in logs.phases]
        for name, stops in logs.stops.items():
            print(f"\n{name}: {format_stops(stops)}")
            body[name], tables[f"recorded, {name}"] = stops.as_dict(), stops.scores
    if _DATA.value:
        dataset = open_dataset(_DATA.value)
        data = {"data_hash": dataset.hash}
        scores = compare_stored(dataset.load(None))
        print("\n".join(format_scores("stored", scores)))
        body["stored"] = [score.as_dict() for score in scores]
        tables["stored against today's rules"] = scores
    if not body:
        noises = _NOISE.value[:1] if _QUICK.value else _NOISE.value
        count = 1 if _QUICK.value else _TRAFFIC.value
        places = executor()
        for noise in noises:
            report = measure_traffic(count, noise, _SEED.value, executor=places)
            print(f"{format_labels(report)}\n")
            body[noise] = report.as_dict()
            tables[f"noise {noise}, decisions"] = report.decisions
            tables[f"noise {noise}, tags"] = report.tags
    folder = Path(_OUTPUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    picture = label_chart(folder / "labels.png", tables)
    body["made_by"] = {**provenance(logs=parts), **data}
    write_json(folder / "labels.json", body)
    print(f"written: {folder}/labels.json, {picture.name}")


if __name__ == "__main__":
    run(main)
