"""How often is the gate wrong? Its verdicts where the truth is known by construction.

    swapped     candidate and incumbent exchange their drives in cases drawn by a coin:
                neither is better, whatever they are, and the drives stay paired
    by family   the same with a coin for each family: equal over families, each of which
                may well lose, so only what is judged over families can be wrong
    redrawn     one driver against itself, on the cases of two seeds of the catalogue:
                equal, and the drives have nothing to do with each other
    as driven   a pair that is better or worse, or that nobody knows the truth of
    constructed hand-set against itself with other random candidates (equal), with a
                lower wanted speed (worse), with some drives of IDM, which has more
                faults (worse), and the slower one as incumbent (better)

What a gate detects in an equal pair is a false alarm. Rates depend on the number of
cases: at ten cases a family hardly anything can be detected, and margins of a quarter
of a percent cannot be shown, so nothing ships.

Nobody is compared with recordings here. Pairs of `pair_between` count as equally near
to the human, so that the check of likeness passes and gains nothing; a config without
nulls leaves out that the candidate is ahead of rewards that know nothing. Every other
check is the gate's. To ship then takes every check of safety, of no loss and of
families passed, and a gain in a metric. The rule that nothing ships on a part of the
suite is left out too. Host numpy, but for the drivers.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import get_args

import numpy as np
from scipy.special import betaincinv

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.files import SuiteRuns
from rcirl_jax.evaluation.closed_loop.output import text_table
from rcirl_jax.evaluation.exact import CONFIDENCE
from rcirl_jax.evaluation.gate.decision import judge
from rcirl_jax.evaluation.gate.pairs import (
    COINS,
    CONSTRUCTED,
    MIXES,
    constructed_pair,
    joined,
    redrawn,
    stacked,
    swapped,
)
from rcirl_jax.evaluation.gate.types import (
    Decision,
    GateConfig,
    Pair,
    Verdict,
)
from rcirl_jax.simulation.metrics import CaseMetrics

# what a verdict may say: a failed check of a kind, any of them, a gain
SAID = ("safety", "no loss", "families", "refused", "gain")

DECISIONS: tuple[Decision, ...] = get_args(Decision)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tally:
    """What the gate said about pairs of one kind: S suites, D draws of each."""

    name: str
    truth: str  # "equal", "better", "worse" or "unknown", of the candidate
    said: np.ndarray  # [S, D, len(SAID + DECISIONS)] bool
    cases: int  # of a suite
    drives: Mapping[str, object] = dataclasses.field(default_factory=dict)  # `compared`

    def of(self, what: str) -> np.ndarray:
        """[S, D] bool: which verdicts say `what`, one of `SAID` or `DECISIONS`."""
        return self.said[:, :, (*SAID, *DECISIONS).index(what)]

    def rate(self, what: str) -> tuple[float, float, float]:
        """Share of the verdicts that say `what`, with its 95 % interval."""
        return clustered_rate(self.of(what))

    @property
    def decisions(self) -> dict[Decision, int]:
        """Number of verdicts by decision, without those that were never taken."""
        return {w: int(self.of(w).sum()) for w in DECISIONS if self.of(w).any()}


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


def constructed(
    suites: Sequence[SuiteRuns], config: GateConfig, together: int = 1, seed: int = 0
) -> list[Tally]:
    """The gate on the pairs of `CONSTRUCTED`.

    Args:
      suites: drives of `constructed_rows`, one suite per seed of the catalogue.
      config: margins, without nulls.
      together: seeds that are judged as one suite besides; 1: none.
      seed: of the mixes.

    Returns:
      A tally for each pair with one verdict per seed; then, with `together` above 1,
      a tally for each with one verdict for every so many seeds.

    Raises:
      InputError: a suite lacks a row, there are nulls, or fewer suites than `together`.
    """
    if together > len(suites):
        raise InputError(f"--together: {together}: expected at most {len(suites)}")
    rng = np.random.default_rng([seed, MIXES])
    alone, more = [], []
    for made in CONSTRUCTED:
        pairs = [constructed_pair(made, runs, rng) for runs in suites]
        alone.append(as_driven(made.name, made.truth, pairs, config))
        if together > 1:
            firsts = range(0, len(pairs) - together + 1, together)
            large = [joined(pairs[first : first + together]) for first in firsts]
            more.append(as_driven(made.name, made.truth, large, config))
    return alone + more


def tally(name: str, truth: str, suites: Iterable[Iterable[Verdict]]) -> Tally:
    """Count what was said; `suites` hold equally many verdicts each."""
    said, cases = [], 0
    for verdicts in suites:
        rows = []
        for verdict in verdicts:
            failed = {c.kind for c in verdict.checks if c.outcome == "fail"}
            gained = any(
                c.kind == "gain" and c.outcome == "pass" for c in verdict.checks
            )
            kinds = [kind in failed for kind in SAID[:3]]
            decided = [verdict.decision == what for what in DECISIONS]
            rows.append([*kinds, bool(failed), gained, *decided])
            cases = verdict.cases
        said.append(rows)
    return Tally(
        name=name,
        truth=truth,
        said=np.array(said, bool).reshape(len(said), -1, len(SAID + DECISIONS)),
        cases=cases,
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
    """The gate on pairs as they are, and how their drives compare."""
    found = tally(name, truth, ([judge(pair, config)] for pair in pairs))
    mine = stacked([pair.candidate for pair in pairs])
    theirs = stacked([pair.incumbent for pair in pairs])
    return dataclasses.replace(found, drives=compared(mine, theirs))


def compared(mine: CaseMetrics, theirs: CaseMetrics) -> dict[str, object]:
    """How the drives of two rows on the same cases differ, by name.

    Args:
      mine: leaves [C, ...].
      theirs: likewise.

    Returns:
      "way": mean progress, as a share of theirs; "cases_that_differ": cases of another
      progress; "cases_with_own_fault" and "cases_with_red_light": [mine, theirs].
    """
    way, other = (np.asarray(x.progress, np.float64) for x in (mine, theirs))
    count = lambda m, field: int(np.sum(np.asarray(getattr(m, field)) > 0))  # noqa: E731
    return {
        "way": float(way.mean() / other.mean()),
        "cases_that_differ": int(np.sum(way != other)),
        "cases_with_own_fault": [count(m, "at_fault") for m in (mine, theirs)],
        "cases_with_red_light": [count(m, "red_lights") for m in (mine, theirs)],
    }


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
        found.append(
            {
                "candidate": mine,
                "incumbent": theirs,
                "decision": verdict.decision,
                "failed": failed,
                **compared(a, b),
            }
        )
    return found


def format_errors(tallies: Sequence[Tally]) -> str:
    """Shares of verdicts with 95 % intervals: what was decided, then what was said.

    Returns:
      Two tables, each with one line per kind of pair.
    """
    lines = []
    for columns in (DECISIONS, SAID):
        header = ["", "candidate is", "cases", "verdicts", *columns]
        rows = [
            [
                found.name,
                found.truth,
                f"{found.cases:,}",
                f"{found.of(columns[0]).size:,}",
                *(_share(found.rate(what)) for what in columns),
            ]
            for found in tallies
        ]
        lines += [*text_table(header, rows), ""]
    return "\n".join(lines)


def _share(rate: tuple[float, float, float]) -> str:
    share, low, high = (100.0 * x for x in rate)
    return f"{share:.1f} % [{low:.1f}, {high:.1f}]"
