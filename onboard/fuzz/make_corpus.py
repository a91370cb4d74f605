"""Seed corpus and dictionary of the fuzz target `fuzz_load`, from the Python writer.

    python -m onboard.fuzz.make_corpus --output=out/corpus

One seed is a byte that says what follows (0: a file, 1: the body of one) and a small
file of every activation and depth, with and without scene gating and a prior cost. The
dictionary, `weights.dict` beside the folder, holds the words of the format.
"""

import itertools
from pathlib import Path

import msgpack
from absl import app, flags

from rcirl_jax.export import reader
from tests.export.test_weights import packed

_OUTPUT = flags.DEFINE_string("output", "out/corpus", "folder of the seeds")


def main(_: list[str]) -> None:
    """Write the seeds and, beside their folder, the dictionary."""
    folder = Path(_OUTPUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    kinds = itertools.product(
        reader.ACTIVATIONS, (False, True), (False, True), ((), (2,), (3, 2))
    )
    for activation, gated, prior, hidden in kinds:
        data = packed(
            features=2,
            times=2,
            hidden=hidden,
            activation=activation,
            scene_gating=gated,
            with_prior=prior,
        )
        name = f"{activation}_{len(hidden)}_{gated:d}_{prior:d}"
        (folder / f"file_{name}").write_bytes(b"\0" + data)
        (folder / f"body_{name}").write_bytes(b"\1" + msgpack.unpackb(data)["body"])
    keys = {*reader.OUTER_KEYS, *reader.BODY, *reader.RANGES, *reader.ACTIVATIONS}
    keys |= {*reader.BODY["prior_cost"][0], *reader.BODY["samples"]}
    keys |= {"name", "unit", "none_value", "leaky_rate", "hand-set"}
    keys |= {"shape", "dtype", "data", "<f4"}
    lines = [f'"\\x{0xA0 + len(key):x}{key}"' for key in sorted(keys)]
    (folder.parent / "weights.dict").write_text("\n".join(lines) + "\n")
    print(f"written: {folder}, {folder.parent / 'weights.dict'}")


if __name__ == "__main__":
    app.run(main)
