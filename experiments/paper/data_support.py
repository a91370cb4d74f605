"""What the data support: weights, how sure each choice is, and the reasons for it.

    python -m experiments.paper.data_support --data=DATASET --output=DIR [--quick]

Three answers on the same frozen candidates. Which weights of the linear reward
the data support, free and as costs of what departs from the median on either side, per
unit of the feature, with intervals from vehicles. How far
apart the members of an ensemble (21-15-1, logistic pairs; other initial weights,
the same batches), and draws of the last layer's Laplace posterior, choose (m), and
whether unsure choices are worse ones. Which features speak for the chosen
candidate against the one nearest to the human, and how its error grows; the latter
also of --judged, trained as in `human_likeness`. Expected
with US-101: five minutes on one core; 8 of 21 free weights supported, that either doubt
warns of errors is not shown, the error is worth a steady 0.2 m/s^2. `--quick`: a
minute.
"""

import dataclasses

import numpy as np
from absl import flags

from experiments.common import run
from experiments.paper.common import base, dataset, fixed, picture, seeds, write
from rcirl_jax.evaluation.insight.data_support import (
    Choices,
    choices_of,
    growth,
    rank_correlation,
    reasons,
    weights_supported,
)
from rcirl_jax.evaluation.insight.identify import to_json
from rcirl_jax.evaluation.insight.identify_text import format_report
from rcirl_jax.evaluation.ranking.learners import (
    LEARNERS,
    FrozenSets,
    learner_config,
    train_grid,
    train_learner,
)
from rcirl_jax.features import feature_map
from rcirl_jax.report.tuning.support_picture import support_picture
from rcirl_jax.reward import RewardConfig
from rcirl_jax.units import TIMES_S

_JUDGED = flags.DEFINE_enum(
    "judged",
    "MaxEnt monotone 32-16",
    sorted(x for x in LEARNERS if not x.endswith("on curves")),
    "a further row's error in time",
)
fixed(positive="nearest")  # what is chosen is compared with the nearest candidate


def _error_over_time(made: Choices, time_valid: np.ndarray, of: str) -> list:
    """Rows of `growth` at the times that count, printed."""
    found = growth(made.ahead, time_valid)
    print(f"error of the chosen by {of}: {made.error.mean():.2f} m over time")
    for t, (size, bias, worth) in zip(TIMES_S, found, strict=True):
        if np.isfinite(size):
            print(f"{t:.1f} s: {size:.2f} m, bias {bias:+.2f} m, {worth:.2f} m/s^2")
    return found[np.isfinite(found[:, 0])].tolist()


def main() -> None:
    """Train a linear reward and an ensemble, ask the three questions, draw."""
    runs = seeds(least=2)
    data, config = dataset(), base(reward=RewardConfig(pin="none"))
    sets = {name: FrozenSets(data, name) for name in ("train", "test")}
    train, test = (sets[name].of(config) for name in ("train", "test"))
    vehicle = {name: np.asarray(made.rows.vehicle) for name, made in sets.items()}
    linear = learner_config("logistic linear", base())
    (reward,) = train_learner(train, linear, [0])
    weights = weights_supported(reward, train, vehicle["train"])
    strict = learner_config("logistic non-negative", base())
    (reward,) = train_learner(train, strict, [0])
    costs = weights_supported(reward, train, vehicle["train"])
    (found,) = train_grid(train, config, [config.leaky_rate], runs).values()
    made = choices_of(found, train, test, vehicle["train"])
    spreads = {"seeds": made.spread_of_seeds, "posterior": made.spread_of_posterior}
    warns = {
        name: rank_correlation(spread, made.error, vehicle["test"])
        for name, spread in spreads.items()
    }
    # the gap in the mean value is the mean of the runs' gaps
    each = [reasons(run, test, made.chosen, made.nearest) for run in found]
    shares = np.mean(each, axis=0)
    names = feature_map(config.features).names
    print(format_report(weights))
    print(f"as costs of departures from the median:\n{format_report(costs)}")
    for name, spread in spreads.items():
        rho, low, high = warns[name]
        print(
            f"{name}: the chosen ends {np.median(spread):.2f} m (median) apart; rank "
            f"correlation with its error {rho:.2f} [{low:.2f}, {high:.2f}]"
        )
    valid = np.asarray(test.time_valid)
    over_time = _error_over_time(made, valid, "logistic 21-15-1")
    judged = learner_config(_JUDGED.value, base())
    train, test = (sets[name].of(judged) for name in ("train", "test"))
    others = train_learner(train, judged, runs)
    chosen = choices_of(others, train, test, vehicle["train"])
    over_time_judged = _error_over_time(chosen, valid, _JUDGED.value)
    support_picture(
        picture("data_support"),
        weights=weights,
        spreads=spreads,
        error=made.error,
        reasons={n: shares[:, i] for i, n in enumerate(names)},
    )
    body = {
        "weights": to_json(weights),
        "costs": to_json(costs),
        "choices": {k: v.tolist() for k, v in dataclasses.asdict(made).items()},
        "warns_of_error": warns,
        "error_over_time": over_time,
        "judged": {
            "learner": _JUDGED.value,
            "error": chosen.error.tolist(),
            "error_over_time": over_time_judged,
            "spread_of_seeds": chosen.spread_of_seeds.tolist(),
        },
        "reasons": {n: float(np.abs(shares[:, i]).mean()) for i, n in enumerate(names)},
    }
    write("data_support", body, data)


if __name__ == "__main__":
    run(main)
