"""Experts with a known reward: is it recovered, and does more data help?

    python -m experiments.paper.known_truth --data=DATASET --output=DIR [--quick]

A hidden random 21-15-1 reward replaces the human in every scene; learners see
only its choices (best, or Boltzmann at --temperature) and are asked to choose on
held-out scenes. One hidden reward per seed. Expected with --counts=30,300,3000
--epochs=40 --seeds=8: 40 minutes on one core; under the logistic and listwise losses
agreement rises with the number of scenes and is above that of the GAN, which
compares across scenes; under the leaky-ReLU loss neither shows. Recovery is partial,
0.3 to 0.5 of the choices; with --pin=none logistic and MaxEnt find 0.6 to 0.7, the
GAN still 0.4.
`--quick`: a minute.
"""

import dataclasses

import jax
import numpy as np
import tqdm
from absl import flags

from experiments.common import run, whole_numbers
from experiments.paper.common import (
    QUICK,
    base,
    dataset,
    fixed,
    picture,
    seeds,
    write,
)
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight.known_truth import (
    agreement,
    differences,
    experts,
    hidden_reward,
    learns_from_choices,
)
from rcirl_jax.evaluation.ranking.learners import (
    FrozenSets,
    learner_config,
    normaliser_of,
    train_learner,
)
from rcirl_jax.report.ranking.intervals import curves_panel
from rcirl_jax.report.style import figure, label, save
from rcirl_jax.reward.config import PINS
from rcirl_jax.train.state import TrainConfig

_COUNTS = flags.DEFINE_list(
    "counts", ["30", "100", "300", "1000", "3000"], "training scenes"
)
_TEMPERATURE = flags.DEFINE_float("temperature", 0.0, "of the experts, in values", 0.0)
_LEARNERS = flags.DEFINE_list(
    "learners",
    ["RC-IRL rank", "RC-IRL logistic", "MaxEnt", "GAN"],
    "rows, two at least",
)
_PIN = flags.DEFINE_enum(
    "pin", None, PINS, "scale of the learners' values; the hidden one's is unit"
)
fixed(positive="human")  # the curve that the expert's choice replaces


def main() -> None:
    """Replace the humans, train on ever more of them, compare choices, draw."""
    asked, rows, runs = whole_numbers(_COUNTS.value, "counts"), _rows(), seeds(least=2)
    data, config = dataset(), learner_config("MaxEnt", base())
    train, test = (FrozenSets(data, name).of(config) for name in ("train", "test"))
    most = train.weight.shape[0]
    counts = sorted({min(count, most) for count in asked})
    counts = counts[:2] if QUICK.value else counts
    if len(counts) < 2:
        raise InputError(
            f"--counts: {_COUNTS.value}: expected two that differ, up to {most}"
        )
    same = {name: np.zeros((len(runs), len(counts))) for name in rows}
    regret = {name: np.zeros((len(runs), len(counts))) for name in rows}
    bar = tqdm.tqdm(
        total=len(runs) * len(counts) * len(rows), desc="train", unit="learner"
    )
    for i, seed in enumerate(runs):
        hidden = hidden_reward(1000 + seed, normaliser_of(train, config))
        shown = experts(train, hidden, _TEMPERATURE.value, seed)
        order = np.random.default_rng(seed).permutation(most)
        for j, count in enumerate(counts):
            part = jax.tree.map(lambda x, at=order[:count]: x[at], shown)
            for name in rows:
                epochs = max(round(base().epochs * most / count), 1)
                own = learner_config(name, base(epochs=epochs))
                own = _pinned(own)
                (learned,) = train_learner(part, own, [seed])
                found = agreement(test, hidden, learned)
                same[name][i, j], regret[name][i, j] = found
                bar.update()
    bar.close()
    _draw(counts, same, regret)
    for name in rows:
        print(f"{name:16s} same choice " + "  ".join(
            f"{n}: {x:.2f}" for n, x in zip(counts, same[name].mean(0), strict=True)
        ))  # fmt: skip
    tested = differences(same, against="GAN" if "GAN" in rows else rows[-1])
    for words, (d, p) in tested.items():
        print(f"{words}: {d.mean:+.3f} [{d.low:+.3f}, {d.high:+.3f}], Holm p {p:.3f}")
    body = {n: {"same": same[n].tolist(), "regret": regret[n].tolist()} for n in rows}
    tests = {w: {**dataclasses.asdict(d), "p_holm": p} for w, (d, p) in tested.items()}
    write("known_truth", {"counts": counts, "rows": body, "tests": tests}, data)


def _rows() -> list[str]:
    """--learners, none of which may ask for more than the expert's choice."""
    rows = _LEARNERS.value
    if len(rows) < 2:
        raise InputError(f"--learners: {','.join(rows)}: expected two at least")
    for name in rows:
        if not learns_from_choices(learner_config(name, base())):
            raise InputError(
                f"--learners: {name}: learns from distances to the recorded human, or "
                "from candidates of its own: expected learners of the choice alone"
            )
    return rows


def _pinned(config: TrainConfig) -> TrainConfig:
    """With the scale that --pin asks for, whatever the learner's shape."""
    reward = config.reward
    pin = _PIN.value or reward.pin
    return dataclasses.replace(config, reward=dataclasses.replace(reward, pin=pin))


def _draw(
    counts: list[int], same: dict[str, np.ndarray], regret: dict[str, np.ndarray]
) -> None:
    made, axes = figure(1, 2, 11.0, 4.2)
    curves_panel(axes[0, 0], counts, same)
    label(axes[0, 0], "same choice as the hidden reward", "scenes", "share, 2 s.e.")
    curves_panel(axes[0, 1], counts, regret)
    label(axes[0, 1], "hidden value lost (1: the median candidate)", "scenes", "share")
    for axis in axes[0]:
        axis.set_xscale("log")
    save(made, picture("known_truth"))


if __name__ == "__main__":
    run(main)
