"""A reward as an ONNX model (extra [export]).

    inputs   features [K, T, F] float32, valid [T] bool
    output   value [K] float32, higher is better

The operations are those of docs/weights_format.md in that order, nothing fused, so
that a runtime may; opset 17, IR 8. The file's sha256 and features stand in the
metadata. Of the package's own network: no exporter of any JAX function to ONNX goes
with this package's versions, and other modules have StableHLO (`stablehlo`).
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export.reader import Reward
from rcirl_jax.runtime.atomic_files import write_whole

if TYPE_CHECKING:
    import onnx

OPSET, IR = 17, 8
ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu", "leaky_relu": "LeakyRelu"}


def write_onnx(path: Path, reward: Reward) -> None:
    """Write the model, checked by ONNX's own checker.

    Raises:
      InputError: the package onnx is missing.
    """
    try:
        import onnx
    except ImportError as error:
        raise InputError(
            "onnx: not installed: expected pip install 'rcirl-jax[export]'"
        ) from error
    model = _model(onnx, reward)
    onnx.checker.check_model(model, full_check=True)
    write_whole(path, model.SerializeToString())


class _Graph:
    """Nodes in order; every call appends one and names its result."""

    def __init__(self, onnx) -> None:  # noqa: ANN001
        self.onnx, self.nodes, self.constants = onnx, [], []

    def constant(self, name: str, value: np.ndarray) -> str:
        self.constants.append(self.onnx.numpy_helper.from_array(value, name))
        return name

    def node(self, kind: str, *inputs: str, result: str = "", **attributes) -> str:  # noqa: ANN003
        name = result or f"{kind.lower()}_{len(self.nodes)}"
        made = self.onnx.helper.make_node(kind, list(inputs), [name], **attributes)
        self.nodes.append(made)
        return name


def _model(onnx, reward: Reward) -> "onnx.ModelProto":  # noqa: ANN001
    graph, single = _Graph(onnx), np.float32
    array = lambda name: np.asarray(getattr(reward, name), single)  # noqa: E731
    limits = {name: graph.constant(name, array(name)) for name in _NORMALISER}
    x = graph.node("Max", "features", limits["lower"])
    x = graph.node("Min", x, limits["upper"])
    x = graph.node("Sub", x, limits["location"])
    x = graph.node("Div", x, limits["scale"])
    if reward.scene_gating is not None:
        first = graph.node("Gather", x, graph.constant("first", np.array([0])), axis=1)
        context = graph.constant("context", np.asarray(reward.scene_gating, single))
        gain = graph.node("Sigmoid", graph.node("MatMul", first, context))
        gain = graph.node("Mul", gain, graph.constant("two", np.array(2.0, single)))
        x = graph.node("Mul", x, gain)
    last = len(reward.kernels) - 1
    for i, (kernel, bias) in enumerate(zip(reward.kernels, reward.biases, strict=True)):
        weights = graph.constant(f"kernel_{i}", np.asarray(kernel, single))
        offset = graph.constant(f"bias_{i}", np.asarray(bias, single))
        x = graph.node("Add", graph.node("MatMul", x, weights), offset)
        if i < last and reward.activation != "identity":
            leaky = reward.activation == "leaky_relu"
            kind = ACTIVATIONS[str(reward.activation)]
            if leaky:
                x = graph.node(kind, x, alpha=float(reward.leaky_slope))
            else:
                x = graph.node(kind, x)
    unit = graph.constant("unit_axis", np.array([2]))
    x = graph.node("Squeeze", x, unit)  # [K, T]
    x = graph.node("Mul", x, graph.constant("gamma", array("gamma")))
    zero = graph.constant("zero", np.array(0.0, single))
    x = graph.node("Where", "valid", x, zero)  # a NaN at other times does no harm
    times = graph.constant("time_axis", np.array([1]))
    graph.node("ReduceSum", x, times, result="value", keepdims=0)
    return _wrapped(onnx, graph, reward)


_NORMALISER = ("lower", "upper", "location", "scale")


def _wrapped(onnx, graph: _Graph, reward: Reward) -> "onnx.ModelProto":  # noqa: ANN001
    helper, kinds = onnx.helper, onnx.TensorProto
    times, features = len(reward.times), len(reward.names)
    tensor = helper.make_tensor_value_info
    made = helper.make_graph(
        graph.nodes,
        "reward",
        [
            tensor("features", kinds.FLOAT, ["K", times, features]),
            tensor("valid", kinds.BOOL, [times]),
        ],
        [tensor("value", kinds.FLOAT, ["K"])],
        graph.constants,
    )
    model = helper.make_model(
        made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR
    )
    units = [str(unit) for unit in reward.units]
    helper.set_model_props(
        model,
        {
            "weights_sha256": str(reward.sha256),
            "features": json.dumps(list(reward.names)),
            "units": json.dumps(units),
            "times_s": json.dumps([float(time) for time in reward.times]),
        },
    )
    return model
