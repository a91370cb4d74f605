r"""A site that no learner saw: how well does a tuned reward rank drivers there?

    python -m experiments.paper.left_out_site --output=DIR \
        --sites=us101=out/us101,urban=out/urban,i80=out/i80

For every site the recipe is tuned on the others as `rcirl autotune` does it:
demonstrations, prior cost, all seeds. The test vehicles of that site are then ranked by
it, beside the same recipe tuned on the training vehicles of all sites, the own cost, an
IDM tuned on either, random order and the best candidate, with paired differences. Four
tunings of three seeds take about forty minutes on two cores; the runs are folders in
--output, and the same command goes on where it was stopped. Without --sites: two halves
of the synthetic traffic. `--quick`: V alone, two minutes, its numbers mean nothing.

Only the likelihood "NLL nearest" has seen the site: each row's temperature is fitted on
its training scenes.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments.paper.common import (
    HORIZON,
    OUTPUT,
    QUICK,
    QUICK_COUNTS,
    few,
    picture,
    recipe,
    seeds,
    write,
)
from rcirl_jax.cli.flags import undefine_flags
from rcirl_jax.cli.running import made_by_file, provenance, run
from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import open_dataset, open_datasets
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.baselines import tune_idm
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.evaluation.ranking.evaluate import evaluate_ranking
from rcirl_jax.evaluation.ranking.report import format_table, to_json
from rcirl_jax.evaluation.ranking.score import RankingSetup
from rcirl_jax.export.loading import open_reward, scorer_of
from rcirl_jax.planner.baselines import TUNED_IDM_ROW
from rcirl_jax.report.charts import interval_panel
from rcirl_jax.report.style import figure, label, save
from rcirl_jax.runtime.executors import Serial
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.loop import Running
from rcirl_jax.train.parallel import share_cores
from rcirl_jax.tuning.loop import tune
from rcirl_jax.tuning.recipes import SimulatedDemonstrations
from rcirl_jax.tuning.run import Run, TuneConfig
from rcirl_jax.tuning.stages import IDM_EVALUATIONS

_SITES = flags.DEFINE_list("sites", [], "NAME=DATASET, two or more")
_INCUMBENT = flags.DEFINE_string(
    "incumbent", "hand-set", "the own cost: hand-set, FILE.py:FUNCTION or FILE.so"
)
flags.FLAGS.set_default("seeds", 3)
undefine_flags("data", "epochs", "positive")

EVERYWHERE, ELSEWHERE = "all sites", "without the site"
QUICK_STRIDE_S = 120.0  # s between planning frames of synthetic traffic


def sites() -> dict[str, str]:
    """Returns datasets by the names of their sites."""
    pairs = [item.partition("=") for item in _SITES.value]
    named = {name: path for name, _, path in pairs}
    if _SITES.value and (len(named) < max(2, len(pairs)) or not all(named.values())):
        raise InputError(
            f"sites: {','.join(_SITES.value)}: expected two or more NAME=DATASET, "
            "named apart"
        )
    return named or {f"half {number}": _half(number) for number in (0, 1)}


def _half(number: int) -> str:
    """Imports every second synthetic recording, once."""
    stride = QUICK_STRIDE_S if QUICK.value else 2.0
    folder = Path(OUTPUT.value) / f"synthetic_{stride:g}s_{number}"
    if not (folder / "manifest.json").exists():
        config = ImportConfig(
            format="synthetic", collect=CollectConfig(stride_s=stride)
        )
        recordings = list(read_recordings("synthetic", None))[number::2]
        import_logs(recordings, folder, config, before_commit=made_by_file())
    return str(folder)


def tuned(name: str, datasets: Sequence[str]) -> Run:
    """Tunes the recipe on datasets, in a folder of a name."""
    chosen = recipe()
    train, on = chosen.train, (chosen.simulated, chosen.gain)
    if QUICK.value:  # V alone: no catalogue is driven
        train = dataclasses.replace(train, epochs=QUICK_COUNTS["epochs"])
        on = SimulatedDemonstrations(), 0.0
    made = Run(
        folder=Path(OUTPUT.value) / name.replace(" ", "_"),
        config=TuneConfig(
            train=train,
            gate=GateConfig(),
            incumbent=_INCUMBENT.value,
            simulated=on[0],
            gain=on[1],
            recipe=chosen.name,
            seeds=len(seeds()),
        ),
        executor=Serial(),
        running=Running(parallel="auto"),
        facts=provenance(),
    )
    print(f"tuned on {', '.join(datasets)}:")
    tune(made, datasets, "train")
    return made


def main() -> None:
    """Tune on all and on all but each, rank each, draw one panel per site."""
    found = sites()
    share_cores(recipe().train.batch_size)
    trained = recipe().train.sampler
    sampler = trained.on_own(SamplerConfig(mode=trained.mode))  # the usual grid
    setup = RankingSetup(horizon_s=HORIZON.value, sampler=sampler)
    everywhere = tuned(EVERYWHERE, [*found.values()])
    usual = tune_idm(open_datasets([*found.values()]), setup, IDM_EVALUATIONS)
    made, axes = figure(1, len(found), 5.5 * len(found), 4.0)
    reports, files = {}, [*everywhere.seed_files]
    for axis, (site, path) in zip(axes[0], found.items(), strict=True):
        others = [other for name, other in found.items() if name != site]
        elsewhere = tuned(f"without {site}", others)
        files += elsewhere.seed_files
        idm = tune_idm(open_datasets(others), setup, IDM_EVALUATIONS)
        learned = {
            row: [scorer_of(open_reward(str(file))) for file in of.seed_files]
            for row, of in ((ELSEWHERE, elsewhere), (EVERYWHERE, everywhere))
        }
        drivers = {ELSEWHERE: idm, EVERYWHERE: usual}
        ranked = dataclasses.replace(
            setup,
            preset=everywhere.config.train.features,
            tuned={f"{TUNED_IDM_ROW}, {row}": [x] for row, x in drivers.items()},
            own=everywhere.own_cost,
        )
        own = ranked.own.name if ranked.own else "hand-set"
        against = [EVERYWHERE, own, *ranked.tuned, "random"]
        data = few(open_dataset(path))
        report = evaluate_ranking(data, learned, ranked, references=against)
        reports[site] = {**to_json(report), "data_hash": data.hash}
        said = format_table(report, 118, differences=False)
        print(f"test vehicles of {site}:\n{said}")
        for one in report.comparisons:
            if one.metric == "top1_fde" and one.row in learned:
                apart = one.difference
                print(
                    f"{one.row} minus {one.reference}, top-1 FDE: {apart.mean:+.2f} m "
                    f"[{apart.low:+.2f}, {apart.high:+.2f}], {one.verdict}"
                )
        shown = [ELSEWHERE, EVERYWHERE, own, *ranked.tuned, "random", "oracle"]
        rows = {name: report.rows[name]["top1_fde"] for name in shown}
        interval_panel(axis, {n: (x.value, x.low, x.high) for n, x in rows.items()})
        label(axis, f"test vehicles of {site}", "top-1 distance, m", "")
    save(made, picture("left_out_site"))
    write("left_out_site", {"sites": reports}, weights=[str(x) for x in files])


if __name__ == "__main__":
    run(main)
