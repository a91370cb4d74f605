"""Every loss against float64 loops over its definition, and what it leaves out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.reward import (
    LOSSES,
    CandidateInfo,
    LossConfig,
    LossInputs,
    loss_sums,
)
from rcirl_jax.reward.losses import CEILING_M

CONFIG = LossConfig()
B, K = 6, 9


def compared(human, candidates, feasible=None, weight=None, offset=0.0, **info):
    """Values [B], [B, K] with plain facts unless given."""
    human, candidates = jnp.asarray(human), jnp.asarray(candidates)
    shape = candidates.shape
    plain = {
        "human_distance": jnp.zeros(shape[0]),
        "human_collides": jnp.zeros(shape[0], bool),
        "distance": jnp.zeros(shape),
        "collides": jnp.zeros(shape, bool),
        "breaks_rule": jnp.zeros(shape),
        "human_density": jnp.zeros(shape[0]),
        "density": jnp.zeros(shape),
        "human_own": jnp.zeros(shape[0]),
        "own": jnp.zeros(shape),
    }
    return LossInputs(
        human=human,
        candidates=candidates,
        feasible=jnp.ones(shape, bool) if feasible is None else jnp.asarray(feasible),
        weight=jnp.ones(shape[0]) if weight is None else jnp.asarray(weight),
        info=CandidateInfo(**{**plain, **info}),
        offset=jnp.asarray(offset),
    )


def drawn(seed=0):
    rng = np.random.default_rng(seed)
    return compared(
        rng.normal(0, 2, B),
        rng.normal(0, 2, (B, K)),
        feasible=rng.random((B, K)) < 0.8,
        weight=np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]),
        human_distance=jnp.asarray(rng.uniform(0, 1, B)),
        distance=jnp.asarray(rng.uniform(0, 20, (B, K))),
        collides=jnp.asarray(rng.random((B, K)) < 0.3),
        breaks_rule=jnp.asarray(rng.uniform(0, 1, (B, K))),
        human_density=jnp.asarray(rng.normal(0, 1, B)),
        density=jnp.asarray(rng.normal(0, 1, (B, K))),
        offset=jnp.asarray(0.3),
    )


def with_info(c, **info):
    return c._replace(info=c.info.replace(**info))


def pair_oracle(name, c, b, k):
    y = c.candidates[b, k] - c.human[b]
    if name == "rank":
        return y if y >= 0 else CONFIG.leaky_rate * y
    if name == "logistic":
        return np.log1p(np.exp(y))
    margin = CONFIG.margin_distance * min(c.info.distance[b, k], CEILING_M)
    margin += CONFIG.margin_collision * c.info.collides[b, k]
    return max(0.0, y + margin + CONFIG.margin_rule * c.info.breaks_rule[b, k])


def scene_oracle(name, c, b, ks):
    v, h = c.candidates[b], c.human[b]
    values = np.array([h, *v[ks]])
    if name == "listwise":
        share = np.exp(
            values - np.array([c.info.human_density[b], *c.info.density[b, ks]])
        )
        mean = np.exp(np.mean([c.info.human_density[b], *c.info.density[b, ks]]))
        return -np.log(np.exp(h) / (mean * share.sum()))
    if name == "soft":
        apart = np.array([c.info.human_distance[b], *c.info.distance[b, ks]])
        label = np.exp(-apart / CONFIG.soft_distance)
        # near is no excuse for a collision
        label *= 1.0 - np.array([c.info.human_collides[b], *c.info.collides[b, ks]])
        label /= label.sum()
        return -np.sum(label * np.log(np.exp(values) / np.exp(values).sum()))
    if name == "risk":
        apart = np.array([c.info.human_distance[b], *c.info.distance[b, ks]])
        hit = np.array([c.info.human_collides[b], *c.info.collides[b, ks]])
        charge = np.where(hit > 0, 10.0, np.minimum(apart, 10.0))
        return np.sum(np.exp(values) / np.exp(values).sum() * charge)
    real = -np.log(1 / (1 + np.exp(-(h + c.offset))))
    fake = [-np.log(1 - 1 / (1 + np.exp(-(v[k] + c.offset)))) for k in ks]
    return real + np.mean(fake)


def oracle(name, c):
    """Mean loss by loops in float64."""
    c = jax.tree.map(lambda x: np.asarray(x, np.float64), c)
    terms = []
    for b in np.flatnonzero(c.weight):
        ks = np.flatnonzero(c.feasible[b])
        if name in ("rank", "logistic", "hinge"):
            terms += [pair_oracle(name, c, b, k) for k in ks]
        else:
            terms.append(scene_oracle(name, c, b, ks))
    return np.mean(terms)


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_equals_its_definition(name):
    c = drawn(1)
    # whatever a candidate that does not count is worth
    c = c._replace(candidates=jnp.where(c.feasible, c.candidates, jnp.inf))
    sums = loss_sums(name, c, CONFIG)
    assert float(sums.loss / sums.terms) == pytest.approx(oracle(name, c), rel=1e-5)
    counts = [(b, k) for b in np.flatnonzero(c.weight) for k in range(K)]
    counts = [at for at in counts if c.feasible[at]]
    won = [c.candidates[b, k] < c.human[b] for b, k in counts]
    assert (float(sums.pairs), float(sums.wins)) == (len(counts), sum(won))
    assert len(counts) < np.count_nonzero(c.weight) * K


def test_soft_labels_of_collisions():
    """A colliding positive has no label, unless everything collides."""
    c = drawn()
    hit = with_info(c, human_collides=jnp.ones(B, bool))
    sums = loss_sums("soft", hit, CONFIG)
    assert float(sums.loss / sums.terms) == pytest.approx(oracle("soft", hit), rel=1e-5)
    all_hit = with_info(hit, collides=jnp.ones((B, K), bool))
    none_hit = with_info(c, collides=jnp.zeros((B, K), bool))
    assert loss_sums("soft", all_hit, CONFIG) == loss_sums("soft", none_hit, CONFIG)


def test_only_pairs_won_are_wins():
    sums = loss_sums("rank", compared([1.0, 1.0], [[2.0, 0.0, 1.0], [5.0] * 3],
                                      weight=[1.0, 0.0]), CONFIG)  # fmt: skip
    assert [float(x) for x in sums] == pytest.approx([0.95, 3.0, 1.5, 3.0])
