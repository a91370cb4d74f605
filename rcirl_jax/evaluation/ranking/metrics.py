"""Ranking metrics of one scorer on held-out scenes, one number per scene.

A scorer gives every candidate and the human a value (higher is better). All
scorers are judged on the same candidates, held in `Outcomes`, by these rules:

- No scene is dropped. Where no candidate is feasible the planner has failed:
  the scene is charged with candidate 0 and the worst value of every share.
- A chosen candidate that crashes while the human does not is a failure. It
  may end close to the human, so its FDE is reported plain and charged.
- Infeasible candidates are never chosen and never compared.
- Ties are broken by the lowest index wherever one candidate must be chosen,
  and count half wherever candidates are counted.

Host numpy, float64. Axes: `S` scenes, `K` candidates.
"""

import dataclasses
import math

import numpy as np
from scipy.optimize import root_scalar

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.statistics import CONFIDENCE, Estimate, clopper_pearson

FAILURE_M = 10.0  # m, least FDE charged for a failure; above every miss limit
TOP_COUNT = 3  # candidates among which top-3 looks (Driving-IRL-NGSIM)
HORIZON_S = 5.0  # s, horizon of the US-101 benchmark (Driving-IRL-NGSIM)

# Limit on the final displacement: 6 m at 5 s and 8 m at 8 s, on a line through
# both. Named after nuPlan's miss rate but tighter: nuPlan allows 8 m and 16 m.
MISS_TIMES_S = (5.0, 8.0)  # s
MISS_LIMITS_M = (6.0, 8.0)  # m

# Bounds of a fitted temperature, in units of the values' spread within scenes.
TEMPERATURE_RANGE = (1e-4, 1e4)  # 1
TEMPERATURE_TOLERANCE = 1e-13  # of its logarithm


@dataclasses.dataclass(frozen=True)
class Metric:
    """A metric of `scene_metrics`: name, unit, and which way is better."""

    title: str
    unit: str  # "%", "m", "nat" or "1"; values of "%" are stored as shares
    higher_is_better: bool
    compared: bool = False  # appears among the paired differences
    weight: str | None = None  # metric that weighs the scenes, for ratios


METRICS: dict[str, Metric] = {
    "percentile_rank": Metric("human rank", "%", True, compared=True),
    "pairwise_accuracy": Metric("pairwise acc.", "%", True, weight="num_pairs"),
    "human_top1": Metric("human first", "%", True),
    "top1_fde_failure": Metric("top-1 FDE+fail", "m", False, compared=True),
    "top1_fde": Metric("top-1 FDE", "m", False, compared=True),
    "top1_ade": Metric("top-1 ADE", "m", False),
    "top3_fde_failure": Metric("top-3 FDE+fail", "m", False),
    "top3_fde": Metric("top-3 FDE", "m", False, compared=True),
    "mrr": Metric("MRR nearest", "1", True, compared=True),
    "nll": Metric("NLL nearest", "nat", False),
    "crash_rate": Metric("crash", "%", False, compared=True),
    "failure_rate": Metric("failure", "%", False),
    "miss": Metric("miss", "%", False),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcomes:
    """Outcome of each candidate; shared by all scorers.

    Distances are between the candidate and the recorded human.
    """

    fde: np.ndarray  # [S, K] m, at the horizon
    ade: np.ndarray  # [S, K] m, mean over the times up to the horizon
    crash: np.ndarray  # [S, K] bool, meets something up to the horizon
    feasible: np.ndarray  # [S, K] bool, inside the vehicle's limits
    cluster: np.ndarray  # [S] int, vehicle the scene was recorded from
    human_crash: np.ndarray  # [S] bool, the recorded human meets something
    horizon_s: float = HORIZON_S  # s, horizon of the distances
    failure_m: float = FAILURE_M  # m, least FDE charged for a failure


def miss_threshold(horizon_s: float) -> float:
    """Returns the largest FDE [m] that is no miss: a line through `MISS_LIMITS_M`."""
    (t0, t1), (d0, d1) = MISS_TIMES_S, MISS_LIMITS_M
    return d0 + (d1 - d0) * (horizon_s - t0) / (t1 - t0)


def scene_metrics(
    values: np.ndarray,
    human_value: np.ndarray,
    outcomes: Outcomes,
    temperature: float = 1.0,
) -> dict[str, np.ndarray]:
    """Returns all ranking metrics of one scorer, per scene.

    `percentile_rank` and `pairwise_accuracy` are the same share in a single
    scene: of the feasible candidates, those valued below the human, ties half.
    They differ in how scenes are pooled. The percentile rank weighs scenes
    alike; the pairwise accuracy weighs comparisons alike, that is, each scene
    by `num_pairs`. They agree where every scene has as many feasible
    candidates. Neither says how well candidates are chosen.

    Args:
      values: [S, K] value of each candidate; read where feasible only.
      human_value: [S] value of the human trajectory.
      outcomes: what happens with each candidate.
      temperature: in units of the values; see `fit_temperature`.

    Returns:
      Metric -> [S] float64. In a scene without feasible candidates: see below.
        percentile_rank, pairwise_accuracy: share in [0, 1]; there 0.
        num_pairs: feasible candidates, the weight of pairwise_accuracy; there
          1, so that the failed scene is still counted.
        human_top1: 1 where the human is strictly above all; there 0.
        top1_fde, top1_ade: m, of the best-valued; there candidate 0.
        top3_fde: m, least FDE of the three best-valued; there candidate 0.
        top1_fde_failure, top3_fde_failure: m, the same, but a failure is
          charged max(FDE, outcomes.failure_m).
        mrr: 1 / rank of the feasible candidate nearest to the human by ADE,
          ties by average rank; there 0.
        nll: nats, -log softmax(values / temperature) of that nearest one over
          the feasible; there log K.
        crash_rate: 1 where the chosen crashes and the human does not.
        failure_rate: 1 where it does, or where nothing is feasible.
        miss: 1 where top1_fde is above `miss_threshold`; there 1.
    """
    values, human_value = _checked(values, human_value, outcomes)
    feasible = np.asarray(outcomes.feasible, bool)
    count = np.sum(feasible, axis=1)
    some = count > 0
    order = np.argsort(-values, axis=1, kind="stable")  # infeasible ones last
    chosen, nearest = chosen_of(values, feasible), _nearest(outcomes)
    crash = (
        np.asarray(outcomes.crash, bool) & ~np.asarray(outcomes.human_crash)[:, None]
    )
    fde = np.asarray(outcomes.fde, np.float64)
    failed = crash | ~some[:, None]
    charged = np.where(failed, np.maximum(fde, outcomes.failure_m), fde)
    top1_fde, chosen_crash = pick(fde, chosen), pick(crash, chosen)
    miss = (top1_fde > miss_threshold(outcomes.horizon_s)) | ~some
    below = np.sum(feasible & (values < human_value[:, None]), axis=1)
    equal = np.sum(feasible & (values == human_value[:, None]), axis=1)
    share = (below + 0.5 * equal) / np.maximum(count, 1)
    own = pick(values, nearest)[:, None]
    rank = np.sum(values > own, axis=1) + 0.5 * (np.sum(values == own, axis=1) + 1.0)
    top = order[:, :TOP_COUNT]
    # differences first: a large common offset must not cost digits
    known = np.where(some[:, None], values, 0.0)
    shifted = (1.0 / temperature) * (known - known.max(axis=1, keepdims=True))
    found = {
        "percentile_rank": share,
        "pairwise_accuracy": share.copy(),
        "num_pairs": np.maximum(count, 1),
        "human_top1": (below == count) & (count > 0),
        "top1_fde": top1_fde,
        "top1_fde_failure": pick(charged, chosen),
        "top1_ade": pick(outcomes.ade, chosen),
        "top3_fde": _best_of(fde, top, feasible),
        "top3_fde_failure": _best_of(charged, top, feasible),
        "mrr": np.where(some, 1.0 / rank, 0.0),
        "nll": np.log(np.exp(shifted).sum(axis=1)) - pick(shifted, nearest),
        "crash_rate": chosen_crash,
        "failure_rate": chosen_crash | ~some,
        "miss": miss,
    }
    return {name: np.asarray(x, np.float64) for name, x in found.items()}


def random_scorer(seed: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns values of a scorer that knows nothing: uniform in [0, 1), Philox.

    Args:
      seed: non-negative; the same seed gives the same values everywhere.
      shape: (S, K).

    Returns:
      values [S, K] and human_value [S].
    """
    generator = np.random.Generator(np.random.Philox(seed))
    drawn = generator.random((shape[0], shape[1] + 1))
    return drawn[:, 1:], drawn[:, 0]


def oracle_fde(outcomes: Outcomes) -> np.ndarray:
    """Returns [S] m, FDE of the best feasible candidate; of candidate 0 if none is."""
    fde = np.asarray(outcomes.fde, np.float64)
    order = np.broadcast_to(np.arange(fde.shape[1]), fde.shape)
    return _best_of(fde, order, outcomes.feasible)


def oracle_scorer(outcomes: Outcomes) -> tuple[np.ndarray, np.ndarray]:
    """Returns values [S, K] and [S] of a scorer that sees the FDE.

    V = -FDE, and 0 for the human. No scorer of the same candidates has a lower
    `top1_fde`; what is left is what the sampler cannot express.
    """
    values = -np.asarray(outcomes.fde, np.float64)
    return values, np.zeros(values.shape[0])


def fit_temperature(values: np.ndarray, outcomes: Outcomes) -> float:
    """Fits the temperature with the least mean NLL of the nearest candidate.

    With b = 1 / temperature, NLL(b) = mean[log sum_k exp(b v_k) - b v_nearest]
    is convex in b, and NLL'(b) = mean[E_b(v) - v_nearest] grows with b. Its root in
    log b is found by Brent's method. Values are divided by their spread first, so
    that fit(c v) = c fit(v). Use TRAINING scenes only.

    Args:
      values: [S, K] values of the training scenes' candidates.
      outcomes: of the same scenes; those without feasible candidates are left
        out, since no temperature can change them.

    Returns:
      Temperature in units of the values. The upper end of `TEMPERATURE_RANGE`
      (times the spread) where the values do not help, the lower end where the
      nearest candidate always wins; 1 where all values in each scene are equal.
    """
    values, _ = _checked(values, np.zeros(np.shape(values)[:1]), outcomes)
    feasible = np.asarray(outcomes.feasible, bool)
    some = feasible.any(axis=1)
    if not some.any():
        raise InputError(
            "fit_temperature: feasible: no scene has a candidate: expected at least one"
        )
    values, feasible = values[some], feasible[some]
    count = feasible.sum(axis=1, keepdims=True)
    centre = np.where(feasible, values, 0.0).sum(axis=1, keepdims=True) / count
    centred = np.where(feasible, values - centre, 0.0)
    largest = np.abs(centred).max()
    if largest <= 1e-14 * np.abs(centre).max() or largest == 0.0:
        return 1.0
    spread = largest * np.sqrt(np.sum((centred / largest) ** 2) / feasible.sum())
    scaled = centred / spread
    target = pick(scaled, _nearest(outcomes)[some])

    def slope(log_b: float) -> float:
        """NLL'(b), times the scenes."""
        logits = np.where(feasible, np.exp(log_b) * scaled, -np.inf)
        weight = np.exp(logits - logits.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        return float(np.sum(np.sum(weight * scaled, axis=1) - target))

    low, high = (-math.log(x) for x in reversed(TEMPERATURE_RANGE))
    if slope(low) >= 0.0:
        at = low
    elif slope(high) <= 0.0:
        at = high
    else:
        found = root_scalar(
            slope, method="brentq", bracket=(low, high), xtol=TEMPERATURE_TOLERANCE
        )
        at = float(found.root)
    return float(spread * np.exp(-at))


def _checked(
    values: np.ndarray, human_value: np.ndarray, outcomes: Outcomes
) -> tuple[np.ndarray, np.ndarray]:
    """Returns float64 values with -inf at infeasible candidates, and the human's.

    Raises:
      InputError: a value of a feasible candidate or a human is NaN or infinite.
    """
    human_value = np.asarray(human_value, np.float64)
    feasible = np.asarray(outcomes.feasible, bool)
    values = np.where(feasible, np.asarray(values, np.float64), -np.inf)
    bad = (feasible & ~np.isfinite(values)).any(axis=1) | ~np.isfinite(human_value)
    if bad.any():
        raise InputError(
            f"scorer: values: NaN or infinity in {int(bad.sum())} scenes, first"
            f" {int(np.argmax(bad))}: expected finite values"
        )
    return values, human_value


def chosen_of(values: np.ndarray, feasible: np.ndarray) -> np.ndarray:
    """Returns [S], the feasible candidate of highest value; 0 where there is none.

    Args:
      values: [S, K], of all candidates.
      feasible: [S, K] bool.
    """
    return np.argmax(np.where(feasible, values, -np.inf), axis=1)


def pick(array: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Returns [S], the entry of each row at its index."""
    return np.take_along_axis(array, index[:, None], axis=1)[:, 0]


def bounded(found: Estimate, values: np.ndarray, unit: str, vehicles: int) -> Estimate:
    """Returns the estimate of a share with an interval within 0 and 1.

    A share that is 0 or 1 in every scene has no bootstrap spread. Its interval is
    then the exact one-sided bound for vehicles, about 3 / vehicles: where a share q
    of vehicles ever shows the event, at most about q of the scenes do.

    Args:
      found: with its bootstrap interval.
      values: [R, S].
      unit: only shares, "%", are changed.
      vehicles: number of clusters.
    """
    if unit != "%":
        return found
    # the other end is certain, so all of the error probability goes to this one
    two_sided = 2.0 * CONFIDENCE - 1.0
    for end in (0.0, 1.0):
        if np.all(values == end):
            low, high = clopper_pearson(int(end) * vehicles, vehicles, two_sided)
            return dataclasses.replace(found, value=end, low=low, high=high, exact=True)
    # stretched run weights can push an end of a share over 0 or 1
    low, high = max(found.low, 0.0), min(found.high, 1.0)
    return dataclasses.replace(found, low=low, high=high)


def _nearest(outcomes: Outcomes) -> np.ndarray:
    """Returns [S], the index of the feasible one with the least ADE; 0 if none."""
    ade = np.where(outcomes.feasible, np.asarray(outcomes.ade, np.float64), np.inf)
    return np.argmin(ade, axis=1)


def _best_of(distance: np.ndarray, top: np.ndarray, feasible: np.ndarray) -> np.ndarray:
    """Returns [S], the least of the feasible in `top`; of candidate 0 if none is."""
    taken = np.take_along_axis(distance, top, axis=1)
    allowed = np.take_along_axis(np.asarray(feasible, bool), top, axis=1)
    least = np.where(allowed, taken, np.inf).min(axis=1)
    return np.where(np.isfinite(least), least, distance[:, 0])
