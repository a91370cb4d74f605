"""Drivers of known truth, made from hand-set, and what the gate says of them."""

import collections
import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns, text_table
from rcirl_jax.evaluation.gate import types as gate
from rcirl_jax.evaluation.gate.verdict import MIN_CLUSTERS, judge
from rcirl_jax.evaluation.statistics import clopper_pearson
from rcirl_jax.planner import rank
from rcirl_jax.planner.plan import Plan
from rcirl_jax.reward.hand import LatticeCost
from rcirl_jax.simulation.rows import Row, rule_row
from rcirl_jax.types import Scene

HAND_SET, IDM, OTHER = "hand-set", "IDM", "other candidates"
SLOWER = {"5 % slower": 0.95, "20 % slower": 0.8}  # wanted speed over the limit
FAULTY = "IDM's faults"  # in some 5 % of the cases
# candidate, incumbent, what is true of the candidate
KINDS = (
    (OTHER, HAND_SET, "equal"),
    *((name, HAND_SET, "worse") for name in SLOWER),
    (FAULTY, HAND_SET, "worse"),
    (HAND_SET, FAULTY, "better"),
)


def made_rows() -> list[Row]:
    """Returns hand-set, itself with other random candidates, two slower ones, IDM."""
    policy = rank.rank_policy(rank.hand_score, rank.RankConfig())

    def other(p: rank.Params, s: Scene, key: jax.Array, *before: Plan | None) -> Plan:
        return policy(p, s, jax.random.fold_in(key, 1), *before)

    rows = {HAND_SET: policy, OTHER: other}
    slower = {name: LatticeCost(speed_share=x).fields() for name, x in SLOWER.items()}
    return [
        *(Row(name=name, policy=made) for name, made in rows.items()),
        rule_row(IDM, IDM),
        *(Row(name=name, policy=policy, params=p) for name, p in slower.items()),
    ]


def with_faults(runs: SuiteRuns) -> SuiteRuns:
    """Adds the row `FAULTY`: IDM drives wherever it is at fault."""
    at_fault = np.asarray(runs.rows[IDM].at_fault) > 0

    def pick(idm: np.ndarray, hand: np.ndarray) -> np.ndarray:
        return np.where(at_fault.reshape(-1, *[1] * (np.ndim(idm) - 1)), idm, hand)

    made = jax.tree.map(pick, runs.rows[IDM], runs.rows[HAND_SET])
    return dataclasses.replace(runs, rows={**runs.rows, FAULTY: made})


def tallied(runs: SuiteRuns, seeds: int, config: gate.GateConfig) -> list[dict]:
    """Judges `KINDS`: on the cases of every seed, and on all.

    Args:
      runs: drives of `made_rows`, `with_faults`; as many cases of each seed in turn.
      seeds: of the catalogue.
      config: margins, without trivial baselines.
    """
    found, size = [], len(runs.ids) // seeds
    for names in KINDS:
        same = dict.fromkeys((gate.CANDIDATE, names[1]), np.ones(MIN_CLUSTERS))
        # rows that measure alike: the verdicts are about closed loop alone
        alike = gate.Likeness(
            distance=same, clusters=np.arange(MIN_CLUSTERS), available=MIN_CLUSTERS
        )
        pair = gate.Pair(runs=runs, mine=names[0], name=names[1], likeness=alike)
        parts = [_part(runs, slice(i * size, (i + 1) * size)) for i in range(seeds)]
        pairs = [dataclasses.replace(pair, runs=part) for part in parts]
        each = collections.Counter(judge(part, config).decision for part in pairs)
        way = [float(np.sum(x.progress)) for x in (pair.candidate, pair.incumbent)]
        one = dict(zip(("candidate", "incumbent", "truth"), names, strict=True))
        one |= {"each": dict(each), "together": judge(pair, config).decision}
        found.append({**one, "way": way[0] / way[1]})
    return found


def _part(runs: SuiteRuns, at: slice) -> SuiteRuns:
    names = ("ids", "groups", "preventable", "trivial", "way")
    rest = {name: getattr(runs, name)[at] for name in names}
    rows = jax.tree.map(lambda x: np.asarray(x)[at], dict(runs.rows))
    return dataclasses.replace(runs, rows=rows, **rest)


def table(found: Sequence[dict]) -> str:
    """Formats the share of the seeds by decision with 95 % intervals."""
    head, lines = ["candidate", "incumbent", "truth"], []
    for one in found:
        total, cells = sum(one["each"].values()), []
        for k in (one["each"].get(decision, 0) for decision in gate.EXIT_CODES):
            low, high = (100.0 * x for x in clopper_pearson(k, total))
            cells.append(f"{100.0 * k / total:.0f} % [{low:.0f}, {high:.0f}]")
        lines.append([*(one[name] for name in head), *cells, one["together"]])
    return "\n".join(text_table([*head, *gate.EXIT_CODES, "all cases"], lines))
