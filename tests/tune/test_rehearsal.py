"""Who drives the catalogue in which round."""

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.tune import rehearsal
from rcirl_jax.tune.rehearsal import Rehearsal
from tests.helpers.weights_files import random_weights


@pytest.mark.parametrize(
    ("weight", "rounds", "weights"),
    [(1.2, 2, (1.2, 0.8, 0.8)), (0.0, 1, (0.0, 0.0)), (1.0, 0, (1.0,))],
)
def test_what_is_not_learned_from_has_no_weight_in_any_round(weight, rounds, weights):
    plan = Rehearsal(teacher="hand-set", weight=weight, rounds=rounds)
    assert plan.weights == weights
    assert Rehearsal(teacher="none", rounds=rounds).weights == ()


@pytest.mark.parametrize(("weight", "alone"), [(1.2, False), (0.0, True)])
def test_a_learner_that_only_shows_where_it_gets_to_drives_alone(
    weight, alone, tmp_path, monkeypatch
):
    asked = {}

    def drive(refs, output, config, **who):
        asked.update(who, stride_s=config.stride_s, seeds={ref.seed for ref in refs})

    monkeypatch.setattr(rehearsal, "drive_catalogue", drive)
    monkeypatch.setattr(rehearsal, "open_dataset", lambda output: output)
    plan = Rehearsal(teacher="hand-set", weight=weight, catalogue_seed=70)
    rehearsal.rehearse(
        1,
        plan,
        tmp_path / "out",
        incumbent="hand-set",
        learner=random_weights(tmp_path / "w.msgpack"),
        before_commit=lambda dataset: None,
    )
    hand_set = rehearsal.teacher_of(plan, "hand-set")
    assert hand_set is not None
    assert (asked["learner"] is None) == alone
    assert (asked["teacher"][0] is hand_set[0]) != alone
    assert asked["stride_s"] == (plan.stride_s if alone else plan.takeover_stride_s)
    assert asked["seeds"] == {71}


def test_weights_below_zero_are_refused():
    with pytest.raises(InputError, match="weight: -1"):
        Rehearsal(teacher="hand-set", weight=-1.0)
