"""For planners of other people: F from plain numbers, scenes from metres.

`features.py` has the plain structs and F of them, `choose.py` filters, values and
chooses (numpy only; copied together with `rcirl_jax/features/columns.py` and
`rcirl_jax/planner/safety.py`); `inputs.py` what people measure; `builder.py` makes
scenes of it. The same in C++: `onboard/`. For users: docs/own_planner.md.
"""
