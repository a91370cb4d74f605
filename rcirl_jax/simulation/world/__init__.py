"""One step of the simulated world, pure and vmappable.

`step` moves ego (`vehicle`) and others (`agents`), `lines` are lights and stop signs,
`observe` is what the planner sees, `judge` who was at fault.
"""
