"""How often is the gate wrong? Its verdicts where the truth is known by construction.

    swapped     candidate and incumbent exchange their drives in cases drawn by a coin:
                neither is better, whatever they are, and the drives stay paired
    by family   the same with a coin for each family: equal over families, each of which
                may well lose, so only what is judged over families can be wrong
    redrawn     one driver against itself, on the cases of two seeds of the catalogue:
                equal, and the drives have nothing to do with each other
    as driven   a pair that is better or worse, or that nobody knows the truth of

What a gate detects in an equal pair is a false alarm. Rates depend on the number of
cases: at ten cases a family hardly anything can be detected. Host numpy.
"""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import jax
import numpy as np
from scipy.special import betaincinv

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import CONFIDENCE
from rcirl_jax.evaluation.gate import judge
from rcirl_jax.evaluation.gate_types import Decision, GateConfig, Pair, Verdict
from rcirl_jax.evaluation.suite_output import text_table
from rcirl_jax.simulation.metrics import CaseMetrics

# what a verdict may say: a failed check of a kind, any of them, a gain
SAID = ("safety", "no loss", "families", "refused", "gain")
COINS = 7919  # of the coins' random stream, which nothing else may share


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tally:
    """What the gate said about pairs of one kind: S suites, D draws of each."""

    name: str
    truth: str  # "equal", "better", "worse" or "unknown", of the candidate
    said: np.ndarray  # [S, D, len(SAID)] bool
    decisions: Mapping[Decision, int]

    def rate(self, what: str) -> tuple[float, float, float]:
        """Share of the verdicts that say `what`, with its 95 % interval."""
        return clustered_rate(self.said[:, :, SAID.index(what)])


def clustered_rate(events: np.ndarray) -> tuple[float, float, float]:
    """Share of events [S, D] with an exact interval for draws that come in suites.

    Clopper and Pearson's interval of n / max(1, d) draws, where the design effect d is
    the variance of the suites' shares over that of independent draws. Where all say the
    same nothing is known of d: n is the number of suites. Of one suite alone, the
    interval is over its draws.
    """
    suites, draws = events.shape
    total, share = events.size, float(events.mean())
    design = 1.0
    if suites > 1 and share in (0.0, 1.0):
        design = draws
    elif suites > 1:
        found = float(events.mean(axis=1).var(ddof=1))
        design = max(1.0, found / (share * (1.0 - share) / draws))
    n, tail = total / design, 0.5 * (1.0 - CONFIDENCE)
    k = share * n
    low = 0.0 if k == 0.0 else float(betaincinv(k, n - k + 1.0, tail))
    high = 1.0 if share == 1.0 else 1.0 - float(betaincinv(n - k, k + 1.0, tail))
    return share, low, high


def swapped(pair: Pair, rng: np.random.Generator, *, by_family: bool = False) -> Pair:
    """The pair with candidate and incumbent exchanged in about half of the cases."""
    if by_family:
        _, family = np.unique(pair.families, return_inverse=True)
        coin = (rng.random(family.max() + 1) < 0.5)[family]
    else:
        coin = rng.random(len(pair.ids)) < 0.5

    def chosen(heads: CaseMetrics, tails: CaseMetrics) -> CaseMetrics:
        def pick(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            a, b = np.asarray(a), np.asarray(b)
            return np.where(coin.reshape(-1, *[1] * (a.ndim - 1)), a, b)

        return jax.tree.map(pick, heads, tails)

    return dataclasses.replace(
        pair,
        candidate=chosen(pair.incumbent, pair.candidate),
        incumbent=chosen(pair.candidate, pair.incumbent),
    )


def redrawn(first: Pair, second: Pair) -> Pair:
    """The incumbent's drives in `first` against its drives in `second`.

    Raises:
      InputError: the two do not have as many cases of the same families.
    """
    if list(first.families) != list(second.families):
        raise InputError("gate_errors: expected two suites of the same families")
    return dataclasses.replace(second, candidate=first.incumbent)


def tally(name: str, truth: str, suites: Iterable[Iterable[Verdict]]) -> Tally:
    """Count what was said; `suites` hold equally many verdicts each."""
    decisions: Counter[Decision] = Counter()
    said = []
    for verdicts in suites:
        rows = []
        for verdict in verdicts:
            failed = {c.kind for c in verdict.checks if c.outcome == "fail"}
            gained = any(
                c.kind == "gain" and c.outcome == "pass" for c in verdict.checks
            )
            kinds = [kind in failed for kind in SAID[:3]]
            rows.append([*kinds, bool(failed), gained])
            decisions[verdict.decision] += 1
        said.append(rows)
    return Tally(
        name=name,
        truth=truth,
        said=np.array(said, bool).reshape(len(said), -1, len(SAID)),
        decisions=dict(decisions),
    )


def equal_pairs(
    pairs: Sequence[Pair], config: GateConfig, swaps: int, seed: int = 0
) -> list[Tally]:
    """The gate on equal pairs made from candidate and incumbent.

    Args:
      pairs: one suite per seed of the catalogue.
      config: margins. NuPlan's score is left out where cases are not paired: it is
        relative to the way that is possible in a case.
      swaps: draws of the coins for every suite.
      seed: of the coins.
    """
    rng = np.random.default_rng([seed, COINS])

    def coins(*, by_family: bool) -> Iterable[Iterable[Verdict]]:
        for pair in pairs:
            yield [
                judge(swapped(pair, rng, by_family=by_family), config)
                for _ in range(swaps)
            ]

    found = [
        tally("swapped", "equal", coins(by_family=False)),
        tally("swapped by family", "equal", coins(by_family=True)),
    ]
    primary = tuple(name for name in config.primary if name != "nuplan")
    unpaired = dataclasses.replace(config, primary=primary or ("progress",))
    twice = list(zip(pairs[::2], pairs[1::2], strict=False))
    if twice:
        judged = ([judge(redrawn(a, b), unpaired)] for a, b in twice)
        found.append(tally("redrawn", "equal", judged))
    return found


def as_driven(
    name: str, truth: str, pairs: Sequence[Pair], config: GateConfig
) -> Tally:
    """The gate on pairs as they are."""
    return tally(name, truth, ([judge(pair, config)] for pair in pairs))


def every_pair(
    pair: Pair, rows: Mapping[str, CaseMetrics], config: GateConfig
) -> list[dict]:
    """What the gate says of every row against every other of one suite.

    Args:
      pair: of the suite; its drives are replaced.
      rows: the drives by name.
      config: margins.
    """
    found = []
    for mine, theirs in itertools.permutations(rows, 2):
        a, b = rows[mine], rows[theirs]
        verdict = judge(dataclasses.replace(pair, candidate=a, incumbent=b), config)
        failed = [c.name for c in verdict.checks if c.outcome == "fail"]
        count = lambda m, field: int(np.sum(np.asarray(getattr(m, field)) > 0))  # noqa: E731
        found.append(
            {
                "candidate": mine,
                "incumbent": theirs,
                "decision": verdict.decision,
                "failed": failed,
                "way": float(np.mean(a.progress) / np.mean(b.progress)),
                "cases_with_own_fault": [count(m, "at_fault") for m in (a, b)],
                "cases_with_red_light": [count(m, "red_lights") for m in (a, b)],
            }
        )
    return found


def format_errors(tallies: Sequence[Tally]) -> str:
    """One line per kind of pair, shares of verdicts with 95 % intervals."""
    header = ["", "candidate is", "verdicts", *SAID]
    rows = [
        [
            found.name,
            found.truth,
            f"{found.said[:, :, 0].size:,}",
            *(_share(found.rate(what)) for what in SAID),
        ]
        for found in tallies
    ]
    return "\n".join(text_table(header, rows)) + "\n"


def _share(rate: tuple[float, float, float]) -> str:
    share, low, high = (100.0 * x for x in rate)
    return f"{share:.1f} % [{low:.1f}, {high:.1f}]"
