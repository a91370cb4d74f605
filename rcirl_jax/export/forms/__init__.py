"""A weights file in other forms: StableHLO, ONNX, YAML of linear costs.

Each is written from a `Reward` and read by others; another form is added here.
"""
