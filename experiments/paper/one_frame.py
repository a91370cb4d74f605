"""The paper's example frame: human, candidates and the chosen in six panels.

    python -m experiments.paper.one_frame --data=DATASET --output=DIR \
        [--weights=FILE] [--row=N] [--quick]

The station-time graph, speeds, and the distances to the followed, overtaken,
stop-line and closest obstacles of one held-out scene (by default one with a
leader and an interesting tag). Without --weights a reward is trained first.
Writes one_frame.png (six panels), the large ST graph, and the drawn numbers as
JSON, with what each feature says for the chosen trajectory against the human's.
Expected: three minutes; human and chosen close together. `--quick`: less.
"""

from pathlib import Path

import numpy as np
from absl import flags

from experiments.paper.common import (
    OUTPUT,
    as_used,
    base,
    dataset,
    fixed,
    instead,
    picture,
    undefine_flags,
    write,
)
from rcirl_jax.cli.running import run
from rcirl_jax.errors import InputError
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.loading import open_reward
from rcirl_jax.report.frames import draw_frame, pick_frames
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.loop import train

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file instead of training")
_ROW = flags.DEFINE_integer("row", None, "dataset row of the scene")
REASONS = 6  # features named on the terminal
fixed(horizon=8.0)
undefine_flags("seeds")


def main() -> None:
    """One scene under one reward."""
    if _WEIGHTS.value:
        instead("weights", "recipe", "epochs", "horizon", "positive")
    data, folder, row = dataset(), Path(OUTPUT.value), _ROW.value
    if row is None:
        row = int(pick_frames(data, 1)[0])
    elif row not in data.indices(None):
        known = data.indices(None)
        raise InputError(
            f"--row: {row}: expected one of the dataset's {known.size:,} rows, "
            f"{known.min()} to {known.max()}"
        )
    file = _WEIGHTS.value
    if not file:
        workdir, file = folder / "one_frame_run", str(folder / "one_frame.msgpack")
        train(data, workdir, base(), provenance=as_used())
        export_run(workdir, data, Path(file))
    reward = open_reward(file)
    mode = str(reward.provenance.get("mode", "speed"))
    frame = draw_frame(
        data, reward, SamplerConfig(mode=mode), row, picture("one_frame"),
        st_graph=picture("one_frame_st"),
    )  # fmt: skip
    rank = float(np.mean(frame.values[frame.feasible] < frame.human_value))
    print(f"scene {row}: {frame.caption}; human above {rank:.0%} of the candidates")
    most = sorted(frame.reasons.items(), key=lambda item: -abs(item[1]))[:REASONS]
    told = ", ".join(f"{name} {part:+.3g}" for name, part in most if part)
    print(f"value of the chosen minus the human's, by feature: {told or 'the same'}")
    write(
        "one_frame",
        {
            "row": row,
            "weights_sha256": reward.sha256,
            "human_value": frame.human_value,
            "chosen_value": float(frame.values[frame.chosen]),
            "human_above_share": rank,
            "reasons": frame.reasons,
            "human_s": frame.human_s.tolist(),
            "chosen_s": frame.chosen_s.tolist(),
        },
        data,
        [file],
    )


if __name__ == "__main__":
    run(main)
