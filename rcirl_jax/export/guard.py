"""Is a plan like what the reward was trained on? Needs numpy only.

May be copied into a planner's repository beside `reader.py`. docs/guard.md says what
it can tell; the rule is

    low  = -inf if first <= lower, else first - margin scale   [first, last]: the
    high = +inf if last >= upper, else last + margin scale         training's range
    share_i = share of the raw entries f_ti of feature i, over all candidates and
              valid times, that lie outside [low_i, high_i] or are not finite

The network clips to [lower, upper]: what lies beyond a limit that the training
reached looks to it like what it saw.

A plan is in distribution if no share is above the limit and every entry is finite.

    guard = Guard(load_weights("weights.msgpack"))
    best, verdict = guard.choose(features, incumbent_values)  # [K, T, F], [K]
"""

import dataclasses
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits:
    """The limits of a plan's departure from the training range; hashable."""

    # scales by which the recorded range of a feature is widened on each side
    margin: float = 0.25
    # largest share of a feature's entries that may lie outside
    share: float = 0.25


@dataclasses.dataclass(frozen=True, kw_only=True)
class GuardResult:
    """The guard's result for one plan."""

    in_distribution: bool
    # one with an entry that is not finite, if any; of those the one with the largest
    # share; the first of equals
    feature: str
    share: float  # of its entries, outside


@np.errstate(over="ignore")
def bounds(reward: Any, limits: Limits) -> tuple[np.ndarray, np.ndarray]:  # noqa: ANN401
    """Return the lowest and highest value in distribution, float32 [F].

    `reward` is a `reader.Reward`, whose file this one does not need. An infinite end
    is an open side.
    """
    margin = limits.margin * np.asarray(reward.scale, np.float64)
    ends = np.asarray(reward.training_range, np.float64)
    first, last = ends.astype(np.float32)
    lower, upper = (np.asarray(x, np.float32) for x in (reward.lower, reward.upper))
    # a value at its cap may lie anywhere beyond; what never varied has no cap
    capped = lower < upper
    low = np.where(capped & (first <= lower), -np.inf, ends[0] - margin)
    high = np.where(capped & (last >= upper), np.inf, ends[1] + margin)
    return low.astype(np.float32), high.astype(np.float32)


class Guard:
    """The check of one reward, and what to do where it fails."""

    def __init__(self, reward: Any, limits: Limits = Limits()) -> None:  # noqa: ANN401
        self.reward, self.limits = reward, limits
        self.low, self.high = bounds(reward, limits)

    @property
    def blind(self) -> tuple[str, ...]:
        """Return features with both sides open: only what is not finite is noticed."""
        both = np.isneginf(self.low) & np.isposinf(self.high)
        names = zip(self.reward.names, both, strict=True)
        return tuple(name for name, is_open in names if is_open)

    def check(
        self, features: np.ndarray, time_valid: np.ndarray | None = None
    ) -> GuardResult:
        """Return the verdict on one plan.

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
        finite = np.isfinite(rows)
        unknown = ~finite.all(axis=0)
        inside = finite & (rows >= self.low) & (rows <= self.high)
        outside = np.sum(~inside, axis=0)
        count = len(rows)
        shares = outside / count if count else np.ones(given.shape[-1])
        worst = int(np.argmax(np.where(unknown, shares + 2.0, shares)))
        fine = not unknown.any() and bool(shares[worst] <= self.limits.share)
        return GuardResult(
            in_distribution=fine,
            feature=self.reward.names[worst],
            share=float(shares[worst]),
        )

    def choose(
        self,
        features: np.ndarray,
        incumbent: np.ndarray,
        time_valid: np.ndarray | None = None,
    ) -> tuple[int, GuardResult]:
        """Return the candidate to drive: the incumbent's out of distribution.

        Args:
          features: [K, T, F] raw features of the candidates.
          incumbent: [K] values of another score, higher is better: another reward's,
            or minus a hand-set cost. A NaN among them is never chosen.
          time_valid: as in `check`.

        Returns:
          Its index, and the verdict.

        Raises:
          ValueError: no candidate, values of other candidates, or none that is a
            number where the incumbent has to choose; a reward with a prior cost, which
            is added to the incumbent's value everywhere (`Reward.total`).
        """
        if getattr(self.reward, "prior_cost", None) is not None:
            raise ValueError(
                "guard: a reward with a prior cost: expected one without: choose by "
                "Reward.total, which leaves the choice to your own cost by itself"
            )
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
