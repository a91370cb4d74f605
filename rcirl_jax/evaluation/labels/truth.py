"""Automatic labels against the truth of constructed drives.

Every family of drives counts alike, which is harder than traffic: precision
depends on how often each class and each near miss occurs.
"""

import functools
from collections.abc import Iterator, Sequence

import numpy as np

from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.scenes.smoothing import harsh_share
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.labels.cases import (
    FAMILIES,
    HISTORY_S,
    RATE_HZ,
    Case,
    Mover,
    at,
    check_noise,
    draw,
    to_recording,
)
from rcirl_jax.evaluation.labels.scores import LabelReport, Verdict, count_verdicts
from rcirl_jax.runtime.executors import Executor, Here
from rcirl_jax.types import Decision, Kind
from rcirl_jax.units import TIMES_S

SAME_M = 4.0  # m, mean distance within which a slot is the road user
COLLECT = CollectConfig(
    min_history_s=HISTORY_S,
    stride_s=100.0,
    require_obstacles=False,
    require_speed_change=False,
)


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
    check_noise(noise)
    names = list(families) or list(FAMILIES)
    unknown = [name for name in names if name not in FAMILIES]
    if unknown:
        raise InputError(f"families: {unknown[0]}: expected of {', '.join(FAMILIES)}")
    work = functools.partial(_judged, cases=cases, noise=noise, seed=seed)
    judged = (executor or Here()).stream(work, names)
    return count_verdicts(judged, noise, "label", cases * len(names))


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
