"""Precision and recall of automatic labels.

    precision = right / predicted,   recall = right / true

per decision over all scored road users and lines, per tag over all scored
scenes; rates of independent cases, with exact binomial intervals.
"""

import collections
import dataclasses
from collections.abc import Iterable, Sequence

import tqdm

from rcirl_jax.evaluation.exact import clopper_pearson
from rcirl_jax.types import Decision, Tag

SHOWN = 20  # kinds of errors in a table

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
    """Labels against truth over all roads."""

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


def count_verdicts(judged: Iterable[list[Verdict] | str], noise: str) -> LabelReport:
    """Count the verdicts of scenes as they come, class by class.

    Args:
      judged: verdicts of each scene, or why it was dropped.
      noise: of the positions, for the report.
    """
    verdicts: list[Verdict] = []
    dropped: collections.Counter[str] = collections.Counter()
    cases = 0
    for found in tqdm.tqdm(judged, desc=f"traffic {noise}", unit="scene"):
        cases += 1
        if isinstance(found, str):
            dropped[found] += 1
        else:
            verdicts += found
    decisions = [v for v in verdicts if v[0] == "decision"]
    tags = [v for v in verdicts if v[0] == "tag"]
    wrong = collections.Counter(v for v in verdicts if v[2] != v[3])
    return LabelReport(
        noise=noise,
        cases=cases,
        dropped=dict(dropped),
        decisions=tuple(_score(d.name, decisions) for d in Decision),
        tags=tuple(_score(t.name, tags) for t in Tag if t != Tag.REHEARSED),
        errors=tuple((*key, count) for key, count in wrong.most_common()),
    )


def _score(name: str, verdicts: Iterable[Verdict]) -> ClassScore:
    return class_scores([name], [verdict[2:] for verdict in verdicts])[0]


def class_scores(
    names: Iterable[str], pairs: Sequence[tuple[str, str]]
) -> tuple[ClassScore, ...]:
    """A score of each name over pairs of (truth, label)."""
    found = []
    for name in names:
        holds = [(truth == name, label == name) for truth, label in pairs]
        found.append(
            ClassScore(
                name=name.lower(),
                right=sum(truth and label for truth, label in holds),
                wrong=sum(label and not truth for truth, label in holds),
                missed=sum(truth and not label for truth, label in holds),
            )
        )
    return tuple(found)


def format_labels(report: LabelReport) -> str:
    """The report as a terminal table, with the most frequent errors."""
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
    for what, family, truth, label, count in report.errors[:SHOWN]:
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
