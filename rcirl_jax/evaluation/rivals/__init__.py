"""Tuned rivals: a hand-set cost and an IDM, tuned by CMA-ES.

What is optimised is in `objectives`, the search in `cma_es`.
"""
