"""RC-IRL against the GAN under one recipe, alone and anchored, driven and ranked.

    python -m experiments.paper.rank_against_gan --data=DATASET[,DATASET] \
        --recipe=tuned --seeds=5 --output=DIR [--quick]

Only people teach: sources weigh the same, every loss learns from the same scenes and
candidates, made once, and but for the loss all is as the recipe says. The rank loss is
homogeneous in V and so needs the pin "unit"; the others keep the recipe's. Each reward
drives catalogue cases and ranks the held-out scenes of every source, in two forms:

    alone      V
    anchored   V_own + gain V,   gain = g spread(V_own) / spread(V)

g is --share. Losses leave V on scales of their own, so g counts in spreads of the own
cost: spread(V) is the standard deviation of V over the feasible candidates of a scene
as the planner sees it, averaged over training scenes, as many of every source. With the
default of g the listwise loss has about the gain of `tuned`.

Differences are paired by case, or scene; their intervals resample families, or
vehicles, and seeds together. "smooth" is |jerk| below 6 m/s^3 throughout, "at fault"
and "red lights" are counts of a seed. Expected with US-101, urban and I-80, five seeds
and 276 cases of 120 s: half an hour of two cores, with the recipe `paper` a quarter.
`--quick`: three minutes, numbers without meaning.
"""

import dataclasses
import datetime
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags
from numpy.typing import ArrayLike

from experiments.paper.common import (
    DATA,
    HORIZON,
    OUTPUT,
    QUICK,
    QUICK_S,
    dataset,
    epochs,
    few,
    fixed,
    picture,
    positive,
    recipe,
    seeds,
    write,
)
from experiments.paper.step_sizes import with_chosen_rates
from rcirl_jax.cli.running import provenance, run
from rcirl_jax.data.store.dataset import (
    Demonstrations,
    JoinedDatasets,
    open_datasets,
)
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, run_suite
from rcirl_jax.evaluation.ranking.evaluate import rank_scenes
from rcirl_jax.evaluation.ranking.learners import (
    FrozenSets,
    Learned,
    fitting_rows,
    train_learner,
)
from rcirl_jax.evaluation.ranking.score import RankingSetup, candidates_key
from rcirl_jax.evaluation.statistics import (
    Difference,
    combine_seeds,
    family_clusters,
    paired_difference,
)
from rcirl_jax.export.closed_loop import score_of, table_rows
from rcirl_jax.export.from_run import verification_samples, write_weights
from rcirl_jax.export.loading import open_reward, scorer_of
from rcirl_jax.export.reader import PriorCost
from rcirl_jax.features import feature_map
from rcirl_jax.planner.prediction import with_predicted_futures
from rcirl_jax.planner.rank import ONLINE, Params, Score, hand_score
from rcirl_jax.report.charts import Interval, interval_chart
from rcirl_jax.reward import LOSSES, seen_range
from rcirl_jax.sampling import sample
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics, nuplan_score
from rcirl_jax.simulation.rows import TRIVIAL_BASELINES
from rcirl_jax.simulation.suite import FULL_S, catalogue_set, suite_refs
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning.prior_cost import OWN_COST, some_scenes
from rcirl_jax.types import Scene

_LOSSES = flags.DEFINE_list(
    "losses", None, "default: rank, gan, and listwise unless the recipe's own is rank"
)
_SHARE = flags.DEFINE_float("share", 0.009, "g, above 0", 0.0)
_CASES = flags.DEFINE_integer("cases", 12, "of each family", lower_bound=1)
_DURATION = flags.DEFINE_float("duration", FULL_S, "s of a case", 1.0)
_SEED = flags.DEFINE_integer("catalogue_seed", 0, "of the cases", lower_bound=0)
fixed(horizon=5.0)  # of the ranking; learners compare as far as the recipe says

FORMS = ("alone", "anchored")
BASELINES = (OWN_COST, "IDM", *TRIVIAL_BASELINES)
RANKED_BASELINES = (OWN_COST, "IDM")


def configs() -> dict[str, TrainConfig]:
    """The recipe's training under each loss."""
    told = recipe().train
    default = ["rank", "gan", *([] if told.loss == "rank" else ["listwise"])]
    losses = _LOSSES.value or default
    if not {"rank", "gan"} <= set(losses) <= set(LOSSES):
        known = ", ".join(sorted(LOSSES))
        raise InputError(f"--losses: {losses}: expected rank and gan, all of {known}")
    shared = {"epochs": epochs(), "positive": positive()}
    unit = dataclasses.replace(told.reward, scale_constraint="unit")
    pinned = ("rank", "gan")  # the two that are compared, with one constraint
    rewards = {loss: unit if loss in pinned else told.reward for loss in losses}
    return {
        loss: dataclasses.replace(told, loss=loss, reward=reward, **shared)
        for loss, reward in rewards.items()
    }


def opened() -> tuple[Demonstrations, dict[str, Demonstrations]]:
    """All sources as one, under equal shares, and each by its folder's name."""
    if not DATA.value:
        one = dataset()
        return one, {"synthetic": one}
    urls = DATA.value.split(",")
    data, names = open_datasets(urls), [Path(url).name for url in urls]
    if len(set(names)) < len(names):
        raise InputError(f"--data: {urls}: expected folders of different names")
    parts = data.parts if isinstance(data, JoinedDatasets) else (data,)
    return few(data), dict(zip(names, map(few, parts), strict=True))


def trained(
    data: Demonstrations, learners: Mapping[str, TrainConfig]
) -> tuple[list[Learned], np.ndarray]:
    """Every loss with every seed on one frozen set, and the features' range [2, F].

    Only the listwise loss asks for more facts than the others: its set serves all.
    """
    shared = learners.get("listwise", learners["rank"])
    numbers = seeds(least=2)
    frozen, found = FrozenSets(data).of(shared), []
    for loss, config in learners.items():
        runs = train_learner(frozen, config, numbers, together=True)
        wins = np.mean([one.wins[-1] for one in runs])
        print(f"{loss}: {100.0 * wins:.1f} % of training pairs won", flush=True)
        found += runs
    features = feature_map(shared.features)
    return found, seen_range(fitting_rows(frozen, shared), features)


@functools.partial(jax.jit, static_argnames="score")
def spread(scenes: Scene, rows: jax.Array, score: Score, params: Params) -> jax.Array:
    """Mean [] over scenes [S] of the deviation over their feasible candidates."""

    def one(item: tuple[Scene, jax.Array]) -> tuple[jax.Array, jax.Array]:
        scene = with_predicted_futures(item[0])
        scene = scene.replace(time_valid=jnp.ones_like(scene.time_valid))
        candidates = sample(candidates_key(item[1]), scene, ONLINE)
        counts = candidates.feasible
        values = score(params, scene, candidates)
        return jnp.std(values, where=counts), jnp.any(counts)

    found, counts = jax.lax.map(one, (scenes, rows))
    return jnp.mean(found, where=counts)


def written(
    learned: Sequence[Learned],
    share: float,
    data: Demonstrations,
    sources: Sequence[Demonstrations],
    seen: np.ndarray,
) -> tuple[dict[str, str], dict[str, float]]:
    """Weights files by run, "LOSS FORM SEED", and the spread of every V."""
    scenes, rows = some_scenes(sources)
    samples = verification_samples(data, learned[0].config)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    made_by = {**provenance(), "dataset_sha256": data.hash, "created": now}
    spreads = {OWN_COST: float(spread(scenes, rows, hand_score, None))}
    files: dict[str, dict[str, str]] = {form: {} for form in FORMS}

    def save(form: str, one: Learned, on: PriorCost | None) -> str:
        name = f"{one.config.loss} {form} {one.config.seed}"
        path = Path(OUTPUT.value) / "weights" / f"{name.replace(' ', '-')}.msgpack"
        metrics = {"pair_accuracy": float(one.wins[-1])}
        own = {**made_by, "seed": one.config.seed, "metrics": metrics}
        of = (one.params, one.normaliser, one.config, samples, own, seen)
        write_weights(path, *of, prior_cost=on)
        files[form][name] = str(path)
        return str(path)

    for one in learned:
        file = save("alone", one, None)
        of = spreads[file] = float(spread(scenes, rows, *score_of(open_reward(file))))
        unit = spreads[OWN_COST] / of
        save("anchored", one, PriorCost(incumbent=OWN_COST, gain=share * unit))
    return {**files["alone"], **files["anchored"]}, spreads


@dataclasses.dataclass(frozen=True, kw_only=True)
class Column:
    """One number of every run in every case, or scene, by row."""

    runs: Mapping[str, np.ndarray]  # row -> [R, N]
    cluster: np.ndarray  # [N] what is resampled together

    def minus(self, a: str, b: str) -> Difference:
        """Row a minus row b."""
        return paired_difference(self.runs[a], self.runs[b], self.cluster)

    def interval(self, row: str) -> Interval:
        """The mean with its interval."""
        found = combine_seeds(self.runs[row], self.cluster)
        return found.value, found.low, found.high


def column(found: Mapping[str, ArrayLike], cluster: np.ndarray) -> Column:
    """From [N] of every run, by name: those of a row are "ROW SEED"."""
    runs: dict[str, list[np.ndarray]] = {}
    for name, x in found.items():
        row = name if name in BASELINES else name.rpartition(" ")[0]
        runs.setdefault(row, []).append(np.asarray(x, np.float64))
    return Column(runs={row: np.stack(x) for row, x in runs.items()}, cluster=cluster)


def driven(files: Mapping[str, str], cases: int, duration: float) -> dict[str, Column]:
    """Drives the cases with every run and the baselines.

    Args:
      files: of `written`.
      cases: of each family.
      duration: s of a case.
    """
    which = "free_cruise,stopped_lead" if QUICK.value else "full"
    rows = table_rows([*files.values()], BASELINES, names=[*files])
    refs = suite_refs(which, cases, _SEED.value)
    result = run_suite(rows, catalogue_set(refs, duration), SuiteConfig())
    count, own = len(refs), np.mean(result.rows[OWN_COST].progress)

    def measures(m: CaseMetrics) -> dict[str, ArrayLike]:
        return {
            "nuPlan": 100.0 * nuplan_score(m, jnp.asarray(result.way))[0],
            "progress, m": m.progress,
            f"of {OWN_COST}'s, %": 100.0 * m.progress / own,
            "smooth, %": 100.0 * m.holds[:, COLUMNS.index("j_station")],
            # their means are counts over all cases
            "at fault": count * (m.at_fault > 0),
            "red lights": count * m.red_lights,
        }

    found = {name: measures(m) for name, m in result.rows.items()}
    cluster = family_clusters(result.cases.groups)
    return {
        key: column({name: x[key] for name, x in found.items()}, cluster)
        for key in found[OWN_COST]
    }


def ranked(one: Demonstrations, files: Mapping[str, str]) -> Column:
    """Top-1 errors on the held-out scenes of a source, as the planner sees them."""
    told = recipe().train
    sampler, horizon = told.sampler, HORIZON.value
    setup = RankingSetup(preset=told.features, sampler=sampler, horizon_s=horizon)
    scorers = {name: [scorer_of(open_reward(file))] for name, file in files.items()}
    made = rank_scenes(one, scorers, setup)
    names = (*files, *RANKED_BASELINES)
    errors = {name: made.table[name][0]["top1_fde"] for name in names}
    return column(errors, made.outcomes.cluster)


def _apart(d: Difference) -> str:
    return f"{d.mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]"


def print_table(columns: Mapping[str, Column]) -> None:
    """A line per row: nuPlan against hand-set, then means with the range of seeds."""
    nuplan = columns["nuPlan"]
    heads = [f"nuPlan minus {OWN_COST}", *columns]
    print(f"{'':18}" + "".join(f"{head:>25}" for head in heads))
    for row in nuplan.runs:
        cells = [_apart(nuplan.minus(row, OWN_COST))]
        for runs in (x.runs.get(row) for x in columns.values()):
            each = np.zeros(1) if runs is None else runs.mean(axis=1)
            span = f" ({each.min():.2f}..{each.max():.2f})" if each.size > 1 else ""
            cells.append("-" if runs is None else f"{each.mean():.2f}{span}")
        print(f"{row:18}" + "".join(f"{cell:>25}" for cell in cells))


def main() -> None:
    """Train, drive, rank, compare, draw."""
    learners, (data, sources) = configs(), opened()
    learners, how = with_chosen_rates(data, learners)
    learned, seen = trained(data, learners)
    each = [*sources.values()]
    files, spreads = written(learned, _SHARE.value, data, each, seen)
    errors = {f"top-1 {site}, m": ranked(one, files) for site, one in sources.items()}
    cases, duration = (1, QUICK_S) if QUICK.value else (_CASES.value, _DURATION.value)
    columns = {**driven(files, cases, duration), **errors}
    print_table(columns)
    rows = [row for row in columns["nuPlan"].runs if row not in BASELINES]
    pairs = [(row, OWN_COST) for row in rows]
    pairs += [(f"rank {form}", f"gan {form}") for form in FORMS]
    tests = {
        f"{a} minus {b}": {name: x.minus(a, b) for name, x in columns.items()}
        for a, b in pairs
    }
    drawn = {"nuPlan": columns["nuPlan"], **errors}
    for form in FORMS:
        found = tests[f"rank {form} minus gan {form}"]
        for name in drawn:
            print(f"rank {form} minus gan {form}: {name}: {_apart(found[name])}")
        better = "the rank loss" if found["nuPlan"].mean > 0.0 else "the GAN"
        sure = (
            f"{better} drives better" if found["nuPlan"].is_apart else "not told apart"
        )
        print(f"{form}, in driving: {sure}")
    panels = {name: (name.removesuffix(", m"), "m") for name in errors}
    interval_chart(
        picture("rank_against_gan"),
        {"nuPlan": ("nuPlan score", "of 100"), **panels},
        {
            row: {name: x.interval(row) for name, x in drawn.items()}
            for row in (*rows, *RANKED_BASELINES)
        },
        3.2,
    )
    runs = {
        name: {row: found.mean(axis=1).tolist() for row, found in x.runs.items()}
        for name, x in columns.items()
    }
    sizes = {name: dataclasses.asdict(x) for name, x in how.items()}
    body = {"step_sizes": sizes, "spreads": spreads, "runs": runs, "tests": tests}
    used = {"losses": [*learners], "cases": cases, "duration": duration}
    write("rank_against_gan", body, data, [*files.values()], **used)


if __name__ == "__main__":
    run(main)
