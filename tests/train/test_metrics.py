"""metrics.jsonl as it is read again: damaged lines, missing numbers."""

import json
from pathlib import Path

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export.from_run import last_metrics
from rcirl_jax.report.frames import draw_training
from rcirl_jax.train.metrics import (
    MetricsWriter,
    pairs_won,
    plateau_warning,
    read_metrics,
)

WHOLE = {"loss": 0.5, "pair_accuracy": 0.75, "pairs": 4.0, "queries_per_s": 1.0}


def write(folder: Path, lines: list[str]) -> Path:
    path = folder / "metrics.jsonl"
    path.write_text("".join(line + "\n" for line in lines))
    return path


def line(step: int, **values: object) -> str:
    return json.dumps({"step": step, **WHOLE, **values})


def test_a_damaged_line_is_left_out(tmp_path):
    damaged = (
        '{"step": 2, "loss": 0.', "[1]", '{"loss": 1.0}', '{"step": "2"}',
        '{"step": Infinity}', '{"step": true}', "[" * 100_000, "",
        '{"step": 1' + "0" * 400 + "}", '{"step": 2, "\\ud800": 1.0}',
    )  # fmt: skip
    path = write(tmp_path, [line(1), *damaged, line(3, loss=0.25)])
    assert [row["step"] for row in read_metrics(path)] == [1, 3]
    assert last_metrics(tmp_path)["loss"] == 0.25
    (tmp_path / "pictures").mkdir()
    (picture, _), *_ = draw_training(tmp_path, tmp_path / "pictures")
    assert picture.read_bytes()[:4] == b"\x89PNG"
    MetricsWriter(tmp_path, resume_step=2).close()
    assert path.read_text() == line(1) + "\n"


def test_pairs_won_are_those_of_the_last_steps(tmp_path):
    lines = [line(1), line(2, pairs=10.0, pair_accuracy=0.5), line(3, pairs=30.0)]
    path = write(tmp_path, lines)
    assert pairs_won(path, 2) == pytest.approx((10 * 0.5 + 30 * 0.75) / 40)
    write(tmp_path, [line(1), line(2, pairs=None)])
    with pytest.raises(InputError, match="1 whole lines at its end: expected 2"):
        pairs_won(path, 2)


@pytest.mark.parametrize(
    ("steps", "tau", "noise", "words"),
    [
        (500, 100.0, 0.01, ""),
        (500, 500.0, 0.001, "before a plateau: 17 % of the loss's whole fall"),
        (500, 500.0, 2.0, ""),  # not told from noise
        (500, -500.0, 0.0, "the loss did not fall in 500 steps"),
        (30, 5.0, 0.0, "30 steps do not show whether"),
    ],
)
def test_a_training_that_ends_too_early_is_told(steps, tau, noise, words):
    """An exponential: of n = tau steps the shares follow from its integrals."""
    at = np.arange(steps) + 0.5
    drawn = np.random.default_rng(0).normal(size=steps)
    found = plateau_warning(3.0 + np.exp(-at / tau) + noise * drawn)
    assert words in found
    assert bool(words) == bool(found)
