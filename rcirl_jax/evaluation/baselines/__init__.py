"""Tuned baselines: a hand-set cost and an IDM, tuned by CMA-ES.

What is optimised is in `objectives`, the searches in `cma_es` and `tpe`.
"""
