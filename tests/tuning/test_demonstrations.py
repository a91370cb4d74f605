"""Who drives the catalogue in which round."""

import pytest

from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning import demonstrations
from rcirl_jax.tuning.recipes import SimulatedDemonstrations
from tests.helpers.weights_files import random_weights


@pytest.mark.parametrize(
    ("weight", "rounds", "weights"),
    [(1.2, 2, (1.2, 0.8, 0.8)), (0.0, 1, (0.0, 0.0)), (1.0, 0, (1.0,))],
)
def test_what_is_not_learned_from_has_no_weight_in_any_round(weight, rounds, weights):
    plan = SimulatedDemonstrations(expert="own cost", weight=weight, rounds=rounds)
    assert plan.weights == weights
    assert SimulatedDemonstrations(expert="none", rounds=rounds).weights == ()


@pytest.mark.parametrize(("weight", "alone"), [(1.2, False), (0.0, True)])
def test_a_learner_that_only_shows_where_it_gets_to_drives_alone(
    weight, alone, tmp_path, monkeypatch
):
    asked = {}

    def drive(refs, output, config, **who):
        asked.update(who, stride_s=config.stride_s, seeds={ref.seed for ref in refs})

    monkeypatch.setattr(demonstrations, "drive_catalogue", drive)
    monkeypatch.setattr(demonstrations, "open_dataset", lambda output: output)
    plan = SimulatedDemonstrations(expert="own cost", weight=weight, catalogue_seed=70)
    demonstrations.drive_round(
        1,
        plan,
        tmp_path / "out",
        config=TrainConfig(),
        incumbent="hand-set",
        learner=random_weights(tmp_path / "w.msgpack"),
        before_commit=lambda dataset: None,
    )
    hand_set = demonstrations.expert_of(plan, "hand-set", TrainConfig())
    assert hand_set is not None
    assert (asked["learner"] is None) == alone
    assert (asked["expert"][1].own == hand_set[1].own) != alone
    assert asked["stride_s"] == (plan.stride_s if alone else plan.takeover_stride_s)
    assert asked["seeds"] == {71}


@pytest.mark.parametrize("expert", ["driver model", "own cost"])
def test_where_paths_are_planned_the_expert_plans_them(expert):
    plan = SimulatedDemonstrations(expert=expert)
    config = TrainConfig(sampler=SamplerConfig(mode="path_speed"))
    found = demonstrations.expert_of(plan, "hand-set", config)
    assert found is not None
    assert vars(found[0])["steers"]
