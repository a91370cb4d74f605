"""How the features of a batch are laid out, cut up and rounded: gradients per second.

    python -m benchmarks.layouts

The loss and its gradient from cached features (64 scenes, 122 candidates), in turn:

    points first            [B, K, T, F]: normalise, then the layers, as one writes it
    features first          [B, F, T, K]: points along the long axis of every product
    features first, n       n scenes at a time, gradients added by a scan
    bf16 features, n        features kept in half the bytes, computed in float32
    bf16, n                 products and sums in bfloat16 as well

Medians over rounds, and the time of each over that of the training step's own form.
Beside every row how far its gradient is from the first row's, relative to the largest
entry, and with a reward trained for some steps: the share of feasible pairs
(human, candidate) ordered as in float32 and of scenes with the same first choice.
The training step uses bfloat16 nowhere; these are the numbers to decide that by.
"""

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks.common import write
from rcirl_jax.evaluation.ranking.learners import normaliser_of
from rcirl_jax.reward import Compared, loss_sums, value
from rcirl_jax.train.frozen import freeze
from rcirl_jax.train.pieces import added, in_pieces
from rcirl_jax.train.state import FeatureBatch, TrainConfig
from rcirl_jax.train.step import compare, init_state, make_train_step
from rcirl_jax.types import Normaliser, RewardParams
from tests.helpers.scenes import demonstration

SCENES = 64
PIECES = (1, 2, 4, 16)  # scenes at a time
BF16 = jnp.bfloat16

_ROUNDS = flags.DEFINE_integer("rounds", 11, "rounds")
_CALLS = flags.DEFINE_integer("calls", 5, "gradients of a way in a round")
_STEPS = flags.DEFINE_integer("steps", 100, "steps of training before agreement")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

CONFIG = TrainConfig(batch_size=SCENES)
Compare = Callable[[RewardParams, FeatureBatch], Compared]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Form:
    """One way to come from cached features to values."""

    compare: Compare
    batch: FeatureBatch
    pieces: int = SCENES  # scenes at a time


def _points_first(batch: FeatureBatch, normaliser: Normaliser) -> Form:
    """The batch with features last; values by `reward.value`."""
    every = jnp.concatenate(
        [batch.human[:, None], jnp.moveaxis(batch.candidates, 1, 3).swapaxes(1, 2)],
        axis=1,
    )

    def compare_last(params: RewardParams, part: FeatureBatch) -> Compared:
        found = value(
            params, normaliser, part.candidates, part.time_valid[:, None], CONFIG.reward
        )
        first = batch.replace(weight=part.weight)  # whose values nobody asks for
        rest = compare(params, normaliser, first, CONFIG.reward)
        return rest._replace(human=found[:, 0], candidates=found[:, 1:])

    return Form(compare=compare_last, batch=batch.replace(candidates=every))


def _forms(batch: FeatureBatch, normaliser: Normaliser) -> dict[str, Form]:
    """All ways by name."""

    def plain(params: RewardParams, part: FeatureBatch) -> Compared:
        return compare(params, normaliser, part, CONFIG.reward)

    def rounded(params: RewardParams, part: FeatureBatch) -> Compared:
        half = functools.partial(jax.tree.map, lambda x: x.astype(BF16))
        part = part.replace(human=part.human.astype(BF16))
        made = compare(half(params), half(normaliser), part, CONFIG.reward)
        whole = lambda x: x.astype(jnp.float32)  # noqa: E731
        return made._replace(human=whole(made.human), candidates=whole(made.candidates))

    stored = batch.replace(candidates=batch.candidates.astype(BF16))
    own = SCENES // in_pieces(batch)[0].size
    forms = {
        "points first": _points_first(batch, normaliser),
        "features first": Form(compare=plain, batch=batch),
    }
    for size in sorted({*PIECES, own}):
        form = Form(compare=plain, batch=batch, pieces=size)
        forms[f"features first, {size}"] = form
    forms[f"bf16 features, {own}"] = Form(compare=plain, batch=stored, pieces=own)
    forms[f"bf16, {own}"] = Form(compare=rounded, batch=stored, pieces=own)
    return forms


def _gradient(form: Form) -> Callable[[RewardParams, FeatureBatch], RewardParams]:
    """Gradient of the mean loss by this form."""

    def sums_of(params: RewardParams, part: FeatureBatch) -> tuple:
        def total(params: RewardParams) -> tuple[jax.Array, jax.Array]:
            compared = form.compare(params, part)
            sums = loss_sums(CONFIG.loss, compared, CONFIG.loss_config)
            return sums.loss, sums.terms

        return jax.grad(total, has_aux=True)(params)

    def mean(params: RewardParams, batch: FeatureBatch) -> RewardParams:
        if form.pieces == SCENES:
            grads, terms = sums_of(params, batch)
        else:
            cut = lambda x: x.reshape(-1, form.pieces, *x.shape[1:])  # noqa: E731
            parts = jax.tree.map(cut, batch)
            grads, terms = added(functools.partial(sums_of, params), parts)
        return jax.tree.map(lambda g: g / terms, grads)

    return jax.jit(mean)


def _apart(one: RewardParams, other: RewardParams) -> float:
    """Largest difference, relative to the largest entry of `one`."""
    flat = [
        np.concatenate([np.ravel(x) for x in jax.tree.leaves(g)]) for g in (one, other)
    ]
    return float(np.max(np.abs(flat[0] - flat[1])) / np.max(np.abs(flat[0])))


def _agreement(found: Compared, exact: Compared, feasible: jax.Array) -> dict:
    """Pairs ordered, and candidates chosen, as in float32."""
    above = lambda c: c.human[:, None] > c.candidates  # noqa: E731
    first = lambda c: jnp.argmax(  # noqa: E731
        jnp.where(feasible, c.candidates, -jnp.inf), axis=1
    )
    same = (above(found) == above(exact))[feasible]
    return {
        "pairs_ordered_alike": round(float(jnp.mean(same)), 5),
        "same_choice": round(float(jnp.mean(first(found) == first(exact))), 4),
    }


def main(_: list[str]) -> None:
    """All forms in turn."""
    made = [demonstration(seed) for seed in range(SCENES)]
    rows = jax.tree.map(lambda *x: np.stack(x), *made)
    batch = jax.tree.map(jnp.asarray, freeze(rows, np.arange(SCENES), CONFIG))
    state = init_state(CONFIG, normaliser_of(batch, CONFIG))
    step = jax.jit(make_train_step(CONFIG))
    trained = state
    for _ in range(_STEPS.value):
        trained, _ = step(trained, batch)
    forms = _forms(batch, state.normaliser)
    own = f"features first, {SCENES // in_pieces(batch)[0].size}"
    calls = {name: _gradient(form) for name, form in forms.items()}
    exact = forms["features first"].compare(trained.params, batch)
    result: dict = {"scenes": SCENES, "own": own, "rows": {}}
    base = calls["points first"](state.params, forms["points first"].batch)
    for name, form in forms.items():
        grads = calls[name](state.params, form.batch)
        found = form.compare(trained.params, form.batch)
        result["rows"][name] = {
            "gradient_apart": float(f"{_apart(base, grads):.2g}"),
            **_agreement(found, exact, batch.feasible),
        }
    taken: dict[str, list[float]] = {name: [] for name in forms}
    for _ in range(_ROUNDS.value):
        for name, form in forms.items():
            begin = time.perf_counter()
            jax.block_until_ready(
                [calls[name](state.params, form.batch) for _ in range(_CALLS.value)]
            )
            taken[name].append((time.perf_counter() - begin) / _CALLS.value)
    median = {name: float(np.median(seconds)) for name, seconds in taken.items()}
    for name, row in result["rows"].items():
        row |= {
            "ms": round(1e3 * median[name], 3),
            "to_own": round(median[name] / median[own], 2),
        }
        print(f"{name}: {row}", flush=True)
    print(f"written: {write('layouts', result, _OUTPUT.value)}")


if __name__ == "__main__":
    app.run(main)
