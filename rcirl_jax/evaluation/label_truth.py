"""Automatic labels against the truth of constructed drives: precision, recall.

    precision = right / predicted,   recall = right / true

per decision over all scored road users and lines, per tag over all scored
scenes. Both are rates of independent cases, with exact binomial intervals.
Precision depends on how often each class and each near miss occurs: here every
family counts alike, which is harder than traffic.
"""

import collections
import dataclasses
import functools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import tqdm

from rcirl_jax.data.collect import Collector
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.smoothing import harsh_share
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import clopper_pearson
from rcirl_jax.evaluation.label_cases import (
    FAMILIES,
    HISTORY_S,
    NOISES,
    RATE_HZ,
    Case,
    Mover,
    at,
    draw,
    to_recording,
)
from rcirl_jax.executor import Executor, Here
from rcirl_jax.types import Decision, Kind, Tag
from rcirl_jax.units import TIMES_S

SAME_M = 4.0  # m, mean distance within which a slot is the road user
COLLECT = CollectConfig(
    min_history_s=HISTORY_S,
    stride_s=100.0,
    require_obstacles=False,
    require_speed_change=False,
)

# (what, family, truth, label) of one scored thing; truth and label are names
Verdict = tuple[str, str, str, str]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassScore:
    """How well one decision or tag is found."""

    name: str
    right: int  # labelled and true
    wrong: int  # labelled, not true
    missed: int  # true, not labelled

    @property
    def true(self) -> int:
        """Cases in which it is true."""
        return self.right + self.missed

    def precision(self) -> tuple[float, float, float] | None:
        """(rate, low, high), or None without a label."""
        return _rate(self.right, self.right + self.wrong)

    def recall(self) -> tuple[float, float, float] | None:
        """(rate, low, high), or None without a true case."""
        return _rate(self.right, self.true)

    def as_dict(self) -> dict:
        """JSON-ready."""
        return {
            "name": self.name,
            "true": self.true,
            "right": self.right,
            "wrong": self.wrong,
            "missed": self.missed,
            "precision": self.precision(),
            "recall": self.recall(),
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class LabelReport:
    """Labels against truth over all families."""

    noise: str
    cases: int
    dropped: dict[str, int]  # drop reason -> cases
    decisions: tuple[ClassScore, ...]
    tags: tuple[ClassScore, ...]
    # (what, family, truth, label, count), most frequent first
    errors: tuple[tuple[str, str, str, str, int], ...]

    def as_dict(self) -> dict:
        """JSON-ready."""
        return {
            "noise": self.noise,
            "cases": self.cases,
            "dropped": self.dropped,
            "decisions": [score.as_dict() for score in self.decisions],
            "tags": [score.as_dict() for score in self.tags],
            "errors": [list(error) for error in self.errors],
        }


def _rate(k: int, n: int) -> tuple[float, float, float] | None:
    return (k / n, *clopper_pearson(k, n)) if n else None


def measure(
    cases: int,
    noise: str = "ngsim",
    seed: int = 0,
    families: Sequence[str] = (),
    executor: Executor | None = None,
) -> LabelReport:
    """Draw `cases` drives of every family, label them, compare.

    Args:
      cases: per family, at least 1.
      noise: key of `NOISES`.
      seed: of all draws.
      families: names of `FAMILIES`; empty: all.
      executor: where they are labelled; default: this process.

    Raises:
      InputError: no cases, an unknown noise or family.
    """
    if cases < 1:
        raise InputError(f"--cases: {cases}: expected at least 1")
    if noise not in NOISES:
        raise InputError(f"--noise: {noise}: expected one of {', '.join(NOISES)}")
    names = list(families) or list(FAMILIES)
    unknown = [name for name in names if name not in FAMILIES]
    if unknown:
        raise InputError(f"families: {unknown[0]}: expected of {', '.join(FAMILIES)}")
    verdicts: list[Verdict] = []
    dropped: collections.Counter[str] = collections.Counter()
    work = functools.partial(_judged, cases=cases, noise=noise, seed=seed)
    judged = (executor or Here()).stream(work, names)
    total = cases * len(names)
    for found in tqdm.tqdm(judged, desc=f"label {noise}", total=total, unit="case"):
        if isinstance(found, str):
            dropped[found] += 1
        else:
            verdicts += found
    return _report(noise, total, dict(dropped), verdicts)


def _judged(
    family: str, cases: int, noise: str, seed: int
) -> Iterator[list[Verdict] | str]:
    """`judge` of every case of a family; independent of other families."""
    for number in range(cases):
        rng = np.random.default_rng((seed, list(FAMILIES).index(family), number))
        yield judge(draw(family, rng), noise, rng)


def judge(case: Case, noise: str, rng: np.random.Generator) -> list[Verdict] | str:
    """Label one case as an import would; or the reason why it is dropped."""
    collector = Collector(to_recording(case, noise, rng), COLLECT)
    row = next(collector.scenes(), None)
    if row is None or row["track"] != 0:
        return next(iter(collector.dropped))
    verdicts: list[Verdict] = []
    for other in case.others:
        if other.id in case.truth:
            label = _decision_about(row, case, other)
            truth = case.truth[other.id]
            verdicts.append(("decision", case.family, truth.name, label.name))
    if case.line_truth is not None:
        label = _decision_about_line(row)
        verdicts.append(("decision", case.family, case.line_truth.name, label.name))
    for tag, truth in case.known_tags().items():
        names = [tag.name if value else "" for value in (truth, row["tags"][tag])]
        verdicts.append(("tag", case.family, names[0], names[1]))
    return verdicts


def _decision_about(row: dict, case: Case, other: Mover) -> Decision:
    """The label of the slot that moves like the other; IGNORE if none does."""
    s = np.array([at(other.s, t) for t in TIMES_S]) - at(case.ego.s, 0.0)
    l = np.array([at(other.l, t) for t in TIMES_S])
    apart = np.abs(0.5 * (row["obstacles.s_lower"] + row["obstacles.s_upper"]) - s)
    apart += np.abs(0.5 * (row["obstacles.l_lower"] + row["obstacles.l_upper"]) - l)
    seen, kind = row["obstacles.valid"], row["obstacles.kind"]
    seen = seen & (kind >= Kind.VEHICLE)[:, None] & (kind <= Kind.STATIC)[:, None]
    count = np.maximum(seen.sum(axis=1), 1)
    mean = np.where(seen.any(axis=1), (apart * seen).sum(axis=1) / count, np.inf)
    slot = int(np.argmin(mean))
    near = mean[slot] < SAME_M
    return Decision(row["decisions"][slot]) if near else Decision.IGNORE


def _decision_about_line(row: dict) -> Decision:
    """The label of the nearest line; IGNORE if no line demands anything."""
    lines = np.isin(row["obstacles.kind"], (Kind.STOP, Kind.VIRTUAL))
    if not lines.any():
        return Decision.IGNORE
    station = np.where(lines, row["obstacles.s_lower"][:, 0], np.inf)
    return Decision(row["decisions"][int(np.argmin(station))])


def _report(
    noise: str, cases: int, dropped: dict[str, int], verdicts: list[Verdict]
) -> LabelReport:
    decisions = [v for v in verdicts if v[0] == "decision"]
    tags = [v for v in verdicts if v[0] == "tag"]
    wrong = collections.Counter(v for v in verdicts if v[2] != v[3])
    return LabelReport(
        noise=noise,
        cases=cases,
        dropped=dropped,
        decisions=tuple(_score(d.name, decisions) for d in Decision),
        tags=tuple(_score(t.name, tags) for t in Tag),
        errors=tuple((*key, count) for key, count in wrong.most_common()),
    )


def _score(name: str, verdicts: Iterable[Verdict]) -> ClassScore:
    pairs = [(truth == name, label == name) for _, _, truth, label in verdicts]
    return ClassScore(
        name=name.lower(),
        right=sum(truth and label for truth, label in pairs),
        wrong=sum(label and not truth for truth, label in pairs),
        missed=sum(truth and not label for truth, label in pairs),
    )


def format_labels(report: LabelReport, errors: int = 20) -> str:
    """The report as a terminal table."""
    lines = [
        f"{report.cases} cases, position noise {report.noise!r}, dropped:"
        f" {sum(report.dropped.values())} {report.dropped or ''}",
        "",
        *format_scores("decision", report.decisions),
        "",
        *format_scores("tag", report.tags),
    ]
    if report.errors:
        lines += ["", f"{'family':<24}{'truth':<14}{'label':<14}{'cases':>6}"]
    for what, family, truth, label, count in report.errors[:errors]:
        rest = "-" if what == "tag" else ""
        lines.append(f"{family:<24}{truth or rest:<14}{label or rest:<14}{count:>6}")
    return "\n".join(lines)


def format_scores(title: str, scores: Iterable[ClassScore]) -> list[str]:
    """Lines of a table, one per class."""
    head = f"{title:<14}{'true':>6}{'precision, %':>24}{'recall, %':>24}"
    return [head, *(_line(score) for score in scores)]


def _line(score: ClassScore) -> str:
    cells = [_cell(score.precision()), _cell(score.recall())]
    return f"{score.name:<14}{score.true:>6}{cells[0]:>24}{cells[1]:>24}"


def _cell(rate: tuple[float, float, float] | None) -> str:
    if rate is None:
        return "-"
    value, low, high = (100.0 * number for number in rate)
    return f"{value:.1f} [{low:.1f}, {high:.1f}]"


def noise_shares(noise: str, cases: int = 40, seed: int = 0) -> tuple[float, float]:
    """Share of |a| > 3 m/s^2, raw and smoothed, of constructed tracks."""
    raw = smooth = total = 0
    for number in range(cases):
        rng = np.random.default_rng((seed, number))
        made = Collector(to_recording(draw("follow", rng), noise, rng), COLLECT)
        for track in made.tracks:
            k, n = harsh_share(track.raw_x, track.raw_y, RATE_HZ)
            raw, total = raw + k, total + n
            smooth += harsh_share(track.x, track.y, RATE_HZ)[0]
    return raw / total, smooth / total
