"""Is a plan like what the reward was trained on? Needs numpy only.

May be copied into a planner's repository beside `reader.py`. docs/guard.md says what
it can tell; the rule is

    x_t   = clip(f_t, lower, upper)                        what the network sees
    range = [low - margin scale, high + margin scale]      with the file's `seen`
          = [location - reach scale, location + reach scale]      without
    share_i = share of the entries x_ti of feature i, over all candidates and
              valid times, that lie outside

A plan is in distribution if no share is above the limit and nothing is NaN.

    guard = Guard(load_weights("weights.msgpack"))
    best, verdict = guard.choose(features, incumbent_values)  # [K, T, F], [K]
"""

import dataclasses
from typing import Protocol

import numpy as np


class Ranged(Protocol):
    """What the guard reads of a reward: `reader.Reward` has it."""

    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def lower(self) -> np.ndarray: ...  # noqa: D102
    @property
    def upper(self) -> np.ndarray: ...  # noqa: D102
    @property
    def location(self) -> np.ndarray: ...  # noqa: D102
    @property
    def scale(self) -> np.ndarray: ...  # noqa: D102
    @property
    def seen(self) -> np.ndarray | None: ...  # noqa: D102
    def value(  # noqa: D102
        self, features: np.ndarray, time_valid: np.ndarray | None = None
    ) -> np.ndarray: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits:
    """How far a plan may depart; hashable."""

    # scales by which the recorded range of a feature is widened on each side
    margin: float = 0.25
    # scales around the location, for files without recorded ranges
    reach: float = 3.0
    # largest share of a feature's entries that may lie outside
    share: float = 0.25


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What the guard says of one plan."""

    in_distribution: bool
    feature: str  # the one with a NaN, else with the largest share; the first of equals
    share: float  # of its entries, outside


@np.errstate(over="ignore")
def bounds(reward: Ranged, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of each feature, float32 [F], in its unit."""
    scale = np.asarray(reward.scale, np.float64)
    if reward.seen is None:
        location = np.asarray(reward.location, np.float64)
        low, high = location - limits.reach * scale, location + limits.reach * scale
    else:
        ends = np.asarray(reward.seen, np.float64)
        low, high = ends[0] - limits.margin * scale, ends[1] + limits.margin * scale
    return low.astype(np.float32), high.astype(np.float32)


class Guard:
    """The check of one reward, and what to do where it fails."""

    def __init__(self, reward: Ranged, limits: Limits = Limits()) -> None:
        self.reward, self.limits = reward, limits
        self.low, self.high = bounds(reward, limits)

    def check(
        self, features: np.ndarray, time_valid: np.ndarray | None = None
    ) -> Verdict:
        """The verdict on one plan.

        Args:
          features: [..., T, F] raw features of all its candidates.
          time_valid: [..., T] of 0 and 1, broadcast to the leading axes; None: all
            valid. Without any valid time nothing is known: out of distribution.

        Raises:
          ValueError: another number of features than the reward's.
        """
        given = np.asarray(features, np.float32)
        if given.ndim < 2 or given.shape[-1] != len(self.reward.names):
            raise ValueError(
                f"guard: features: shape {given.shape}: expected [..., T, "
                f"{len(self.reward.names)}]"
            )
        counts = np.ones(given.shape[:-1], bool)
        if time_valid is not None:
            counts = np.broadcast_to(np.asarray(time_valid) != 0, given.shape[:-1])
        rows = given[counts]  # [n, F]
        unknown = np.isnan(rows).any(axis=0)
        x = np.clip(rows, self.reward.lower, self.reward.upper)
        outside = np.sum(~((x >= self.low) & (x <= self.high)), axis=0)
        count = len(rows)
        shares = outside / count if count else np.ones(given.shape[-1])
        worst = int(np.argmax(np.where(unknown, shares + 2.0, shares)))
        fine = not unknown.any() and bool(shares[worst] <= self.limits.share)
        return Verdict(
            in_distribution=fine,
            feature=self.reward.names[worst],
            share=float(shares[worst]),
        )

    def choose(
        self,
        features: np.ndarray,
        incumbent: np.ndarray,
        time_valid: np.ndarray | None = None,
    ) -> tuple[int, Verdict]:
        """The candidate to drive: the reward's, or the incumbent's out of distribution.

        Args:
          features: [K, T, F] raw features of the candidates.
          incumbent: [K] values of another score, higher is better: another reward's,
            or minus a hand-set cost. A NaN among them is never chosen.
          time_valid: as in `check`.

        Returns:
          Its index, and the verdict.

        Raises:
          ValueError: no candidate, values of other candidates, or none that is a
            number where the incumbent has to choose.
        """
        values = np.asarray(incumbent, np.float64)
        count = np.shape(features)[0]
        if count == 0 or values.shape != (count,):
            raise ValueError(
                f"guard: incumbent: shape {values.shape}: expected a value for each "
                f"of {count} candidates, at least 1"
            )
        verdict = self.check(features, time_valid)
        if verdict.in_distribution:
            return int(np.argmax(self.reward.value(features, time_valid))), verdict
        if np.isnan(values).all():
            raise ValueError("guard: incumbent: all NaN: expected a value to choose by")
        return int(np.argmax(np.where(np.isnan(values), -np.inf, values))), verdict
