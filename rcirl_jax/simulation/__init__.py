"""The closed loop: road, agents, vehicle, observation, judge, catalogue, rollout."""
