"""The choice among a planner's own candidates. Needs numpy only.

A value says nothing of safety: a reward was trained to rank what its safety filter lets
through. `choose` filters first, then values, adds the planner's own values where the
weights have a prior cost, and takes the best of what is left:

    choice = choose(reward, scene, s, l, own=-costs)  # s, l [K, T] m
    if choice.best is None:
        brake(choice.none)                   # one line on why
    for why in choice.why:                   # "": admissible
        log(why)                             # "hits obstacles[0] after 3.29 s"

The filter is the one that the simulator and the gate drive with
(`rcirl_jax/planner/safety.py`). May be copied with the files that `features.py` names.
The same in C++: `onboard/include/rcirl/choose.hpp`.
"""

import dataclasses
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np

try:
    from rcirl_jax.export.own_planner import features
    from rcirl_jax.planner import safety as rules
except ImportError:  # the files were copied
    import features  # pyright: ignore[reportMissingImports]
    import safety as rules  # pyright: ignore[reportMissingImports]

Array = np.ndarray
Reason, TIMES_S = rules.Reason, features.TIMES_S
USUAL = rules.SafetyConfig()
APART_M = 0.25  # m beside each other at one time, from which candidates differ in l
AT_EGO_M = 1.0  # m from the ego within which candidates have to begin
SAME_TIMES_S = 1e-4  # s
TEXTS = {
    Reason.NONE: "",
    Reason.NOT_FEASIBLE: "is not feasible",
    Reason.BODY: "hits {0} after {1:.2f} s",
    Reason.LINE: "passes the line {0} at {1:.2f} s",
    Reason.SPEED: "is over the speed limit at {1:.2f} s",
    Reason.ROAD: "leaves the road at {1:.2f} s",
    Reason.BEND: "has too much lateral acceleration at {1:.2f} s",
    Reason.DISTANCE: "is too near behind {0}",
    Reason.ENTRY: "moves in too near to {0} at {1:.2f} s",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choice:
    """The answer of `choose` for K candidates."""

    best: int | None  # the admissible candidate of the highest value
    none: str  # why there is no best, one line; "" if there is one
    values: Array  # [K] float32, what they are ranked by, higher is better
    admissible: Array  # [K] bool
    why: tuple[str, ...]  # [K] the first rule that each breaks; "" if admissible
    reasons: rules.Explanation  # [K] the same in numbers
    in_distribution: bool | None  # the guard's verdict; None: no guard


def admit(
    scene: features.Scene,
    s: Array,
    l: Array | None = None,
    feasible: Array | None = None,
    safety: rules.SafetyConfig = USUAL,
) -> rules.Explanation:
    """Filter candidates: which rule of `safety` each breaks first.

    Args:
      scene: one planning frame.
      s: [K, T] m, stations at `TIMES_S`.
      l: [K, T] m, lateral offsets, for which the path needs the road's edges; None: all
        drive along the given path.
      feasible: [K] bool, which the vehicle can drive: nothing here knows its limits.
        None: all.
      safety: margins and limits.

    Returns:
      Reason, obstacle and time [s], each [K]; `Reason.NONE` is admissible.

    Raises:
      FeatureError: a number is missing, not finite or out of range.
    """
    given = features.driven(scene, s, l)
    _check_edges(scene, l)
    return _rulings(given, feasible, safety)


def _check_edges(scene: features.Scene, l: Array | None) -> None:
    edges = (scene.path.road_left, scene.path.road_right)
    if l is not None and any(edge is None for edge in edges):
        _fail("scene: path.road_left, path.road_right", None, "edges, for candidates.l")


def _rulings(
    given: features.Driven, feasible: Array | None, safety: rules.SafetyConfig
) -> rules.Explanation:
    count = len(given.motion.s)
    may = np.ones(count, bool) if feasible is None else np.asarray(feasible)
    if may.shape != (count,) or may.dtype != bool:
        _fail("feasible", f"{may.dtype} {may.shape}", f"bool ({count},)")
    with np.errstate(over="ignore", invalid="ignore"):
        candidates = SimpleNamespace(trajectory=given.motion, feasible=may)
        return rules.explain(given.scene, candidates, safety)


def check_times(reward: Any) -> None:  # noqa: ANN401
    """Refuses a reward of another time grid than that of the features.

    Raises:
      FeatureError: it has one.
    """
    times = np.asarray(reward.times)
    if times.shape != TIMES_S.shape or np.abs(times - TIMES_S).max() > SAME_TIMES_S:
        _fail(f"{reward.file}: times", "another grid", "8 i / 17 s, i = 0 .. 17")


def choose(
    reward: Any,  # noqa: ANN401
    scene: features.Scene,
    s: Array,
    l: Array | None = None,
    own: Array | None = None,
    feasible: Array | None = None,
    guard: Any = None,  # noqa: ANN401
    safety: rules.SafetyConfig = USUAL,
) -> Choice:
    """Return the admissible candidate with the highest value.

    Ranked by V; with a prior cost by own + gain V; where a guard finds a plan out of
    distribution, by own alone.

    Args:
      reward: a `reader.Reward`.
      scene: one planning frame.
      s: [K, T] m, stations at `TIMES_S`.
      l: [K, T] m, lateral offsets; None: all drive along the given path.
      own: [K] the planner's own values, its costs negated. A prior cost needs them;
        without one, the guard alone uses them.
      feasible: [K] bool, which the vehicle can drive; None: all.
      guard: a `guard.Guard` of a reward without prior cost; None: no check.
      safety: margins and limits of the filter.

    Returns:
      A choice. `best` is None if no candidate is admissible, or if a plan is out of
      distribution and there are no own values.

    Raises:
      FeatureError: numbers that are missing, not finite or out of range; another time
        grid; candidates that begin elsewhere than the ego; offsets that differ, for
        weights trained along one path (`mode`); a prior cost without own values, or
        with a guard.
    """
    check_times(reward)
    given = features.driven(scene, s, l)
    _check_edges(scene, l)
    _check_start(given, ("s",) if l is None else ("s", "l"))
    if l is not None and reward.mode == "speed":
        _check_alike(reward.file, given)
    reasons = _rulings(given, feasible, safety)
    columns = features.FeatureMap(reward.names, reward.units).of(given)
    values, in_distribution, none = _values(reward, scene, columns, own, guard)
    admissible = reasons.reason == Reason.NONE
    why = tuple(_text(*row) for row in zip(*reasons, strict=True))
    if not none and not admissible.any():
        first = f": candidate 0 {why[0]}" if why else ""
        none = f"none of {len(why)} candidates is admissible{first}"
    best = None if none else int(np.argmax(np.where(admissible, values, -np.inf)))
    return Choice(
        best=best,
        none=none,
        values=values,
        admissible=admissible,
        why=why,
        reasons=reasons,
        in_distribution=in_distribution,
    )


def _values(
    reward: Any,  # noqa: ANN401
    scene: features.Scene,
    columns: Array,
    own: Array | None,
    guard: Any,  # noqa: ANN401
) -> tuple[Array, bool | None, str]:
    """Return the values to rank by [K], the guard's verdict, and why none is best."""
    count, valid = len(columns), scene.time_valid
    if own is not None:
        own = np.asarray(own, np.float32)
        if own.shape != (count,) or not np.isfinite(own).all():
            _fail("own", f"shape {own.shape}", f"{count} finite numbers")
    if reward.prior_cost is not None:
        if own is None:
            _fail(f"{reward.file}: own", None, "own values, for it has a prior cost")
        if guard is not None:
            _fail(f"{reward.file}: guard", "given", "none, for it has a prior cost")
        return reward.total(columns, own, valid), None, ""
    values = reward.value(columns, valid)
    if guard is None or not count:
        return values, None, ""
    verdict = guard.check(columns, valid)
    if verdict.in_distribution:
        return values, True, ""
    if own is not None:
        return own, False, ""
    far = f"{100 * verdict.share:.0f} % of {verdict.feature}"
    return values, False, f"out of distribution: {far}: no own values to choose by"


def _check_start(given: features.Driven, axes: tuple[str, ...]) -> None:
    """Refuse candidates that begin elsewhere than the ego."""
    for axis in axes:
        first, ego = getattr(given.motion, axis)[:, 0], getattr(given.scene.ego, axis)
        for k in np.flatnonzero(np.abs(first - ego) > AT_EGO_M)[:1]:
            expected = f"the ego's place, {ego:.2f} m"
            _fail(f"scene: candidates.{axis}[{k}, 0]", f"{first[k]:.2f} m", expected)


def _check_alike(file: str, given: features.Driven) -> None:
    """Refuse offsets from the path that differ between candidates at one time."""
    aside = given.motion.l - given.path.l
    if not len(aside):
        return
    apart = np.ptp(aside, axis=0)
    t = int(np.argmax(apart))
    if apart[t] > APART_M:
        left, right = int(np.argmax(aside[:, t])), int(np.argmin(aside[:, t]))
        _fail(
            "scene: candidates.l",
            f"{left} and {right} are {apart[t]:.2f} m apart at {TIMES_S[t]:.2f} s",
            f"no offsets, or equal ones: l was not trained ({file}: mode=speed)",
        )


def _text(reason: int, obstacle: int, time_s: float) -> str:
    """Return one line on a rule that was broken, "" for none."""
    return TEXTS[Reason(reason)].format(f"obstacles[{obstacle}]", time_s)


def _fail(field: str, value: object, expected: str) -> NoReturn:
    raise features.FeatureError(f"{field}: {value}: expected {expected}")
