"""The whole loop by one call."""

import pytest

import rcirl_jax


@pytest.mark.slow
def test_it_ends_with_the_verdict_of_the_folder(examples, tmp_path):
    given = {"suite": "stopped_lead", "cases": 30, "duration_s": 2.0, "drives": 8}
    data, run = examples / "data", tmp_path / "run"
    verdict = rcirl_jax.tune(data, run, recipe="quick", epochs=1, **given)
    assert verdict.cases == 30
    assert verdict.decision != "ship"  # on a part of the suite
    for name in ("weights.msgpack", "report.html", "verdict.json"):
        assert (run / name).is_file(), name
    assert verdict.sentence in rcirl_jax.format_report(verdict).replace("\n", " ")
    before = (run / "weights.msgpack").stat().st_mtime_ns
    again = rcirl_jax.tune(data, run, recipe="quick", epochs=1, **given)
    assert again == verdict
    assert (run / "weights.msgpack").stat().st_mtime_ns == before
