"""Who drives the catalogue."""

import pytest

from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning import demonstrations
from rcirl_jax.tuning.recipes import SimulatedDemonstrations


@pytest.mark.parametrize("expert", ["driver model", "own cost"])
def test_where_paths_are_planned_the_expert_plans_them(expert):
    plan = SimulatedDemonstrations(expert=expert)
    config = TrainConfig(sampler=SamplerConfig(mode="path_speed"))
    found = demonstrations.expert_of(plan, "hand-set", config)
    assert found is not None
    assert vars(found[0])["steers"]
