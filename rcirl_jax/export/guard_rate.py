"""How often the guard of a weights file would speak up on recorded scenes."""

import dataclasses

import jax
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.ranking.score import EVALUATION_SEED
from rcirl_jax.export.guard import Guard, Limits, Verdict
from rcirl_jax.export.reader import Reward
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.loop import in_chunks
from rcirl_jax.train.state import TrainConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class GuardRate:
    """Verdicts on the plans of S scenes."""

    verdicts: tuple[Verdict, ...]  # [S]
    index: np.ndarray  # [S] dataset rows

    @property
    def flagged(self) -> list[int]:
        """Dataset rows of the scenes out of distribution, the worst first."""
        pairs = zip(self.verdicts, self.index.tolist(), strict=True)
        bad = [(v.share, row) for v, row in pairs if not v.in_distribution]
        return [row for _, row in sorted(bad, reverse=True)]

    @property
    def by_feature(self) -> dict[str, int]:
        """Flagged scenes by the feature that departs most."""
        names = [v.feature for v in self.verdicts if not v.in_distribution]
        return {name: names.count(name) for name in sorted(set(names))}


def guard_rate(
    reward: Reward, dataset: Demonstrations, split: str, limits: Limits
) -> GuardRate:
    """The guard's verdict on every scene of a split.

    A plan is the feasible candidates of its scene, at the times that were recorded.
    """
    mode = str(reward.provenance.get("mode", "speed"))
    config = TrainConfig(features=reward.preset, sampler=SamplerConfig(mode=mode))
    index, guard = dataset.indices(split), Guard(reward, limits)
    key = jax.random.key(EVALUATION_SEED)
    verdicts = [
        guard.check(points[feasible], valid)
        for made in in_chunks(key, dataset.read(index), index, config)
        for points, feasible, valid in zip(
            made.points, np.asarray(made.feasible), made.time_valid, strict=True
        )
    ]
    return GuardRate(verdicts=tuple(verdicts), index=index)
