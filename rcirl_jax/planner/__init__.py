"""The online planner: safety filter, ranking, ST-graph dynamic programming."""
