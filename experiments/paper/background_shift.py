"""Background shifting, the paper's figure computed, and what it costs.

    python -m experiments.paper.background_shift --output=DIR [--quick]

Writes DIR/background_shift.json and .png. Two frames that differ by a constant:
the widest margin of one frame, the direction of a discriminator that pools both,
and those of the conditional losses. Then a choice problem with a hidden linear
reward, over the size of the background and the number of training frames.

Expected: pooling tilts the direction by about 40 degrees, towards the normal of
the shift, in every draw; the conditional losses stay within a few degrees. With a
background on one direction the GAN falls from the conditional losses' agreement
to two fifths of it and more data do not help; with one in all directions data do.
The conditional losses keep theirs, by algebra, unless features are scaled by
their spread over all frames: then the rank loss, with its unit norm, loses too.
Two minutes on two busy cores; `--quick`, few draws, seeds and points: 30 seconds.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
from absl import flags

from experiments.common import provenance, run
from rcirl_jax.evaluation.insight.background import (
    Learning,
    TwoFrames,
    draw_examples,
    example_numbers,
)
from rcirl_jax.evaluation.insight.background_world import World, summary, sweep
from rcirl_jax.report.tuning.background_picture import background_figure
from rcirl_jax.runtime.atomic_files import write_json

_OUTPUT = flags.DEFINE_string("output", "out/background_shift", "folder to write")
_SEED = flags.DEFINE_integer("seed", 0, "seed of the draws, and the first seed", 0)
_QUICK = flags.DEFINE_bool("quick", False, "few draws, seeds and points")

FRAMES, SIZE = 256, 2.0  # where the other axis of a chart stands still


def main() -> None:
    """Draws, two sweeps, picture; numbers as JSON."""
    quick, folder = _QUICK.value, Path(_OUTPUT.value)
    draws, count = (20, 4) if quick else (200, 20)
    folder.mkdir(parents=True, exist_ok=True)
    world = World(frames=64, learning=Learning(steps=200)) if quick else World()
    seeds = range(_SEED.value, _SEED.value + count)
    sizes = (0.0, 1.0, 4.0) if quick else (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
    counts = (8, 64) if quick else (8, 16, 32, 64, 128, 256, 512)
    moved, still = TwoFrames(), TwoFrames(shift=0.0)
    frames, found = draw_examples(_SEED.value, draws, moved)
    alike = draw_examples(_SEED.value, draws, still)[1]
    body = {
        "draws": draws,
        "seeds": list(seeds),
        "example": example_numbers(found),
        "example_without_shift": example_numbers(alike),
        "by_size": sweep([(min(FRAMES, world.frames), x) for x in sizes], seeds, world),
        "by_frames": sweep([(n, SIZE) for n in counts], seeds, world),
        "two_frames": dataclasses.asdict(moved),
        "world": dataclasses.asdict(world),
        "made_by": provenance(),
    }
    target = folder / "background_shift.json"
    write_json(target, body)
    one, directions = jax.tree.map(lambda x: np.asarray(x[0]), (frames, found))
    picture = folder / "background_shift.png"
    background_figure(picture, one, directions, body["by_size"], body["by_frames"])
    print(summary(body))
    print(f"written: {target} and {picture.name}")


if __name__ == "__main__":
    run(main)
