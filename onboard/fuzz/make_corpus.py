"""Seed corpus and dictionary of the fuzz target `fuzz_load`, from the Python writer.

    python -m onboard.fuzz.make_corpus --output=out/corpus

One seed is a byte that says what follows (0: a file, 1 to 4: the body of a file of
that schema version) and a small file of every activation, depth and version. The
dictionary, `weights.dict` beside the folder, holds the words of the format.
"""

import itertools
from pathlib import Path

import msgpack
from absl import app, flags

from rcirl_jax.export import reader
from tests.export.test_weights import packed

_OUTPUT = flags.DEFINE_string("output", "out/corpus", "folder of the seeds")
VERSIONS = ((), ("seen",), ("anchored",))  # what makes a file one of 1 or 2, 3, 4


def main(_: list[str]) -> None:
    """Write the seeds and, beside their folder, the dictionary."""
    folder = Path(_OUTPUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for activation in reader.ACTIVATIONS:
        for by_context, more in itertools.product((False, True), VERSIONS):
            for hidden in ((), (2,), (3, 2)):
                data = packed(
                    features=2,
                    times=2,
                    hidden=hidden,
                    activation=activation,
                    by_context=by_context,
                    **{key: True for key in more},
                )
                outer = msgpack.unpackb(data)
                version = outer["schema_version"]
                name = f"{activation}_{len(hidden)}_v{version}_{by_context:d}"
                (folder / f"file_{name}").write_bytes(b"\0" + data)
                (folder / f"body_{name}").write_bytes(bytes([version]) + outer["body"])
    keys = {*reader.OUTER_KEYS, *reader.BODY_KEYS, *reader.RANGES, *reader.ACTIVATIONS}
    keys |= {"anchor", *reader.PRIOR_COST_KEYS, "hand-set"}
    keys |= {
        "context",
        "seen",
        "name",
        "unit",
        "none_value",
        "kernel",
        "bias",
        "leaky_rate",
    }
    keys |= {"shape", "dtype", "data", "<f4", "valid", "value"}
    lines = [f'"\\x{0xA0 + len(key):x}{key}"' for key in sorted(keys)]
    (folder.parent / "weights.dict").write_text("\n".join(lines) + "\n")
    print(f"written: {folder}, {folder.parent / 'weights.dict'}")


if __name__ == "__main__":
    app.run(main)
