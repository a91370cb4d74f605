"""The learned time weights gamma_t of RC-IRL and of the GAN, with seed bands.

    python -m experiments.paper.discount_factors --data=DATASET --output=DIR [--quick]

The paper's figure: gamma_t is a free vector, not an exponential; conditional
learning is said to weigh the near future, the discriminator not. All eight seconds
are compared, each learner at the step size that serves it best on validation scenes and
with at least --steps steps, for the share depends on both. `--quick`: under a minute.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np
from scipy.stats import ttest_ind

from experiments.paper.common import base, dataset, fixed, picture, seeds, write
from experiments.paper.step_sizes import plateau_warnings, with_chosen_rates
from rcirl_jax.cli.running import run
from rcirl_jax.evaluation.ranking.learners import (
    Learned,
    learner_config,
    train_learners,
)
from rcirl_jax.evaluation.statistics import holm
from rcirl_jax.report.charts import curves_panel
from rcirl_jax.report.style import figure, label, save
from rcirl_jax.reward import effective_params
from rcirl_jax.units import TIMES_S

ROWS = ("RC-IRL rank", "RC-IRL logistic", "GAN")
NEAR_S = 4.0  # s, where "near" ends
EQUAL = float(np.mean(TIMES_S[1:] <= NEAR_S))  # share of near times, 8 of 17
fixed(horizon=8.0)


def time_weights(runs: list[Learned]) -> np.ndarray:
    """[R, T] gamma of each run, its sign such that the sum is positive.

    The network's output may change sign together with gamma; only the product
    counts, so the sign is a convention.
    """
    found = np.array(
        [effective_params(r.params, r.config.reward)["gamma"] for r in runs]
    )
    return found * np.sign(found.sum(axis=1, keepdims=True))


def near_share(gamma: np.ndarray) -> np.ndarray:
    """[R] share of |gamma| [R, T] up to NEAR_S, without t = 0.

    All candidates begin at one state, so gamma_0 is hardly trained and would add its
    first value. Equal weights have the share EQUAL.
    """
    size = np.abs(gamma) * (TIMES_S > 0.0)
    return size[:, TIMES_S <= NEAR_S].sum(axis=1) / size.sum(axis=1)


def differences(shares: dict[str, np.ndarray]) -> list[dict]:
    """Welch's t between the runs of every two rows, Holm over the pairs.

    Of the spread over seeds on these scenes alone: what other scenes would give is
    not in the intervals.
    """
    found = []
    for row, reference in itertools.combinations(shares, 2):
        test: Any = ttest_ind(shares[row], shares[reference], equal_var=False)
        found.append(
            {
                "row": row,
                "reference": reference,
                "difference": float(shares[row].mean() - shares[reference].mean()),
                "interval": [float(x) for x in test.confidence_interval(0.95)],
                "p": float(test.pvalue),
            }
        )
    adjusted = holm(np.array([one["p"] for one in found]))
    return [{**one, "p_holm": float(p)} for one, p in zip(found, adjusted, strict=True)]


def main() -> None:
    """Train, read gamma, draw."""
    asked, data = seeds(least=2), dataset()
    configs = {name: learner_config(name, base()) for name in ROWS}
    chosen, how = with_chosen_rates(data, configs)
    learned = train_learners(data, chosen, asked)
    gamma = {name: time_weights(runs) for name, runs in learned.items()}
    made, axes = figure(1, 1, 6.8, 4.4)
    curves_panel(axes[0, 0], TIMES_S, gamma)
    axes[0, 0].axhline(0.0, color="#999999", lw=0.8)
    label(axes[0, 0], "learned time weights, band: 2 s.e.", "t, s", "gamma_t (norm 1)")
    save(made, picture("discount_factors"))
    body, shares = {}, {name: near_share(runs) for name, runs in gamma.items()}
    for name, share in shares.items():
        error = share.std(ddof=1) / np.sqrt(share.size)
        print(
            f"{name}: {share.mean():.2f} +- {error:.2f} of |gamma| up to {NEAR_S} s, "
            f"without t = 0 (equal weights: {EQUAL:.2f})"
        )
        body[name] = {
            "gamma": gamma[name].round(5).tolist(),
            "near_share": [float(share.mean()), float(error)],
        }
    apart = differences(shares)
    for one in apart:
        low, high = one["interval"]
        print(
            f"{one['row']} minus {one['reference']}: {one['difference']:+.3f} "
            f"[{low:+.3f}, {high:+.3f}], Holm p {one['p_holm']:.3f}"
        )
    written = {
        "times_s": TIMES_S.tolist(),
        "equal_share": EQUAL,
        "rows": body,
        "differences": apart,
        "step_sizes": {name: dataclasses.asdict(x) for name, x in how.items()},
        "warnings": plateau_warnings(learned),
    }
    write("discount_factors", written, data)


if __name__ == "__main__":
    run(main)
