"""The tuning loop: logs -> reward -> closed loop -> verdict -> report.

`loop.py` is the order of the stages and what is printed, `run.py` the folder of one
run, `recipes.py` the settings that decide it. The stages: `demonstrations.py` makes the
training data, `prior_cost.py` fits the cost beside the reward, `stages.py` trains,
ranks, simulates, judges and draws. What a stage does may change here; how it is done
lives in the packages below.
"""
