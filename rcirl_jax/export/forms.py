"""A reward in forms that other programs read: StableHLO, ONNX, YAML of linear costs.

StableHLO and ONNX (extra [export]) hold one scorer for any number of candidates:

    (features [K, T, F] float32, valid [T] bool) -> value [K] float32, higher is better

T, F and the weights are constants. StableHLO is the package's own program, so it serves
any module; it comes as `jax.export`'s bytes, which `jax.export.deserialize` calls
again, and as portable bytecode for other compilers (IREE, XLA). ONNX has the operations
of docs/weights_format.md in that order, nothing fused, so that a runtime may; opset 17,
IR 8, the file's sha256 and features in the metadata. No exporter of any JAX function to
ONNX goes with this package's versions.

A linear reward, free or non-negative, is exact in the `features` of its YAML:

    cost = sum_t gamma_t sum_i   above_i max(f_i - usual_i, 0)
                               + below_i max(usual_i - f_i, 0)

f_i clipped to [lower_i, upper_i]; costs are per unit of the feature. `frenetix` names
the nearest terms of that planner's cost.yaml. Its terms are integrals of squares or
of absolute values over seconds, so the weights are matched where a feature departs from
the usual by its spread: a start for its planner, not the same cost. A free linear
reward has none: it wants more of a feature or less, never the usual.

Weights of own terms (`features.terms`) come under their own names, beside today's, and
go into the planner's own parameter file in the place of the numbers there.
"""

import json
import re
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export.from_run import read_config
from rcirl_jax.export.loading import features_of, reward_params
from rcirl_jax.export.reader import RANGES, Reward
from rcirl_jax.reward import (
    Normaliser,
    RewardModel,
    RewardParams,
    effective_model,
    value,
)
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.train.loop import restore_run

Form = Literal["jax", "stablehlo"]
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
OPSET, IR = 17, 8  # of ONNX
ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu", "leaky_relu": "LeakyRelu"}
NOT_INSTALLED = "not installed: expected pip install 'rcirl-jax[export]'"
# Frenetix term -> (feature, power of the departure that it integrates)
FRENETIX = {
    "acceleration": ("acceleration", 2),
    "longitudinal_jerk": ("jerk", 2),
    "velocity_offset": ("velocity", 1),
    "distance_to_reference_path": ("l", 1),
    "orientation_offset": ("dl", 1),
}
# the terms of its cost.yaml that no feature of ours stands for
FRENETIX_NONE = (
    *("jerk", "lateral_jerk", "path_length", "lane_center_offset", "velocity"),
    *("distance_to_obstacles", "prediction", "responsibility"),
)
YAML = """\
schema: rcirl-jax/linear-cost
schema_version: 1
source: {{weights_sha256: "{sha256}", preset: "{preset}"}}
# cost = sum_t gamma_t sum_i above_i max(f_i - usual_i, 0)
#                          + below_i max(usual_i - f_i, 0)
times_s: [{times}]
gamma: [{gamma}]
features:
{features}
"""
YAML_FRENETIX = """\
# nearest terms of Frenetix's cost.yaml, matched at one spread of the
# feature: a start for its planner, not the same cost
frenetix:
  cost_weights:
"""


def exported(reward: Reward) -> jax.export.Exported:
    """Return the scorer of a weights file.

    Raises:
      InputError: a file with an output bias, which this package never writes and
        its own scorers leave out because it cancels.
    """
    if np.any(reward.biases[-1]):
        raise InputError(f"{reward.file}: layers: output bias: expected 0")
    effective, normaliser = reward_params(reward)
    model = effective_model(effective, reward.activation)
    return exported_module(model, effective, normaliser)


def exported_run(workdir: Path) -> jax.export.Exported:
    """Return the scorer of a run's newest checkpoint, whatever its R_theta is.

    Raises:
      InputError: no run, or no whole checkpoint.
    """
    config, _ = read_config(workdir)
    state = restore_run(workdir, config)
    return exported_module(RewardModel(config.reward), state.params, state.normaliser)


def exported_module(
    model: RewardModel, params: RewardParams, normaliser: Normaliser
) -> jax.export.Exported:
    """Return V of a module with K left open, for CPUs and NVIDIA GPUs."""

    def program(features: jax.Array, valid: jax.Array) -> jax.Array:
        # each trajectory with its own gates, as the readers of a file value it
        masks = jnp.broadcast_to(valid, features.shape[:2])
        return value(model, params, normaliser, features, masks)

    (count,) = jax.export.symbolic_shape("k")
    shape = (count, model.times, normaliser.scale.shape[0])
    shapes = (
        jax.ShapeDtypeStruct(shape, jnp.float32),
        jax.ShapeDtypeStruct((model.times,), jnp.bool_),
    )
    return jax.export.export(jax.jit(program), platforms=("cpu", "cuda"))(*shapes)


def write_stablehlo(path: Path, made: jax.export.Exported, form: Form) -> None:
    """Write a scorer.

    Raises:
      InputError: the package flatbuffers, which jax.export needs, is missing.
    """
    try:
        portable = form == "stablehlo"
        content = made.mlir_module_serialized if portable else made.serialize()
    except ImportError as error:
        raise InputError(f"flatbuffers: {NOT_INSTALLED}") from error
    write_whole(path, bytes(content))


def write_onnx(path: Path, reward: Reward) -> None:
    """Write the model, checked by ONNX's own checker.

    Raises:
      InputError: the package onnx is missing.
    """
    try:
        import onnx
    except ImportError as error:
        raise InputError(f"onnx: {NOT_INSTALLED}") from error
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []
    helper, kinds = onnx.helper, onnx.TensorProto

    def constant(name: str, array: object, kind: type = np.float32) -> str:
        made = onnx.numpy_helper.from_array(np.asarray(array, kind), name)
        constants.append(made)
        return name

    def node(kind: str, *inputs: str, result: str = "", **attributes: Any) -> str:  # noqa: ANN401
        name = result or f"{kind.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    limits = {name: constant(name, getattr(reward, name)) for name in RANGES}
    x = node("Min", node("Max", "features", limits["lower"]), limits["upper"])
    x = node("Div", node("Sub", x, limits["location"]), limits["scale"])
    if reward.scene_gating is not None:
        first = node("Gather", x, constant("first", [0], np.int64), axis=1)
        product = node("MatMul", first, constant("context", reward.scene_gating))
        x = node("Mul", x, node("Mul", node("Sigmoid", product), constant("two", 2.0)))
    slope = float(reward.leaky_slope)
    own: dict[str, Any] = {"alpha": slope} if reward.activation == "leaky_relu" else {}
    for i, (kernel, bias) in enumerate(zip(reward.kernels, reward.biases, strict=True)):
        x = node("MatMul", x, constant(f"kernel_{i}", kernel))
        x = node("Add", x, constant(f"bias_{i}", bias))
        if i + 1 < len(reward.kernels) and reward.activation != "identity":
            x = node(ACTIVATIONS[reward.activation], x, **own)
    x = node("Squeeze", x, constant("unit_axis", [2], np.int64))  # [K, T]
    x = node("Mul", x, constant("gamma", reward.gamma))
    x = node("Where", "valid", x, constant("zero", 0.0))  # a NaN elsewhere: no harm
    axis = constant("time_axis", [1], np.int64)
    node("ReduceSum", x, axis, result="value", keepdims=0)
    tensor, times = helper.make_tensor_value_info, len(reward.times)
    inputs = [
        tensor("features", kinds.FLOAT, ["K", times, len(reward.names)]),
        tensor("valid", kinds.BOOL, [times]),
    ]
    output = [tensor("value", kinds.FLOAT, ["K"])]
    graph = helper.make_graph(nodes, "reward", inputs, output, constants)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR)
    facts = {
        "weights_sha256": reward.sha256,
        "features": json.dumps(reward.names),
        "units": json.dumps(reward.units),
        "times_s": json.dumps([float(time) for time in reward.times]),
    }
    helper.set_model_props(model, facts)
    onnx.checker.check_model(model, full_check=True)
    write_whole(path, model.SerializeToString())


def linear_costs(reward: Reward) -> tuple[np.ndarray, np.ndarray]:
    """Return (above [F], below [F]): cost per unit of departure from the usual.

    Raises:
      InputError: the reward is not linear, or not in departures from the usual.
    """
    where = f"{reward.file}: layers"
    if reward.scene_gating is not None:
        raise InputError(f"{where}: by context: expected a linear reward")
    scale, kernels = np.asarray(reward.scale, np.float64), reward.kernels
    if len(kernels) == 1:
        slope = -np.asarray(kernels[0], np.float64)[:, 0] / scale
        return slope, -slope
    first, last = (np.asarray(kernel, np.float64) for kernel in kernels[:2])
    alone = np.count_nonzero(first, axis=0) <= 1
    rectified = len(kernels) == 2 and reward.activation == "relu"
    if not rectified or not alone.all() or np.any(reward.biases[0]):
        raise InputError(f"{where}: {len(kernels)}: expected a linear reward")
    parts = -first * last[:, 0]  # [F, H] cost of a unit per scaled feature
    above = np.sum(np.where(first > 0.0, parts, 0.0), axis=1) / scale
    below = np.sum(np.where(first < 0.0, -parts, 0.0), axis=1) / scale
    return above, below


def reward_yaml(reward: Reward) -> str:
    """Return the document of a linear reward."""
    above, below = linear_costs(reward)
    rows = []
    for i, name in enumerate(reward.names):
        numbers = {
            "usual": reward.location[i],
            "lower": reward.lower[i],
            "upper": reward.upper[i],
            "above": above[i],
            "below": below[i],
        }
        body = ", ".join(f"{key}: {_number(x)}" for key, x in numbers.items())
        rows.append(f'  {name}: {{unit: "{reward.units[i]}", {body}}}')
    text = YAML.format(
        sha256=reward.sha256,
        preset=reward.preset,
        times=", ".join(map(_number, reward.times)),
        gamma=", ".join(map(_number, reward.gamma)),
        features="\n".join(rows),
    )
    if len(reward.kernels) == 1:
        return text  # a cost of departures, as Frenetix has them, cannot say it
    # its terms are integrals over seconds, ours sums over times
    per_second = float(np.mean(reward.gamma)) / float(np.mean(np.diff(reward.times)))
    weights = dict.fromkeys((*FRENETIX, *FRENETIX_NONE), 0.0)
    for name, (feature, power) in FRENETIX.items():
        if feature in reward.names:
            i = reward.names.index(feature)
            cost = max(0.5 * float(above[i] + below[i]), 0.0)
            weights[name] = cost * per_second / float(reward.scale[i]) ** (power - 1)
    terms = (f"    {name}: {_number(x)}\n" for name, x in weights.items())
    return text + YAML_FRENETIX + "".join(terms)


def own_weights(reward: Reward) -> dict[str, tuple[float, float]]:
    """Return of each own term the weight today and the tuned one.

    Only their ratios decide, so the tuned ones have the geometric mean of today's.

    Raises:
      InputError: the reward is not one of weights of own terms.
    """
    own, kernels = features_of(reward).own, reward.kernels
    slope = -np.asarray(kernels[0], np.float64)[:, 0] / reward.scale
    if own is None or len(kernels) > 1 or np.any(slope <= 0.0):
        raise InputError(
            f"{reward.file}: {reward.preset}: expected weights of own terms"
        )
    today = np.asarray(own.weights)
    tuned = slope * np.exp(np.mean(np.log(today) - np.log(slope)))
    pairs = zip(own.names, today, tuned, strict=True)
    return {name: (float(before), float(after)) for name, before, after in pairs}


def terms_yaml(reward: Reward) -> str:
    """Return the document of weights of own terms."""
    rows = own_weights(reward)
    blocks = {"weights": 1, "today": 0}
    parts = [
        f"{block}:\n" + "".join(f"  {n}: {_number(x[i])}\n" for n, x in rows.items())
        for block, i in blocks.items()
    ]
    return (
        "schema: rcirl-jax/own-terms\nschema_version: 1\n"
        f'source: {{weights_sha256: "{reward.sha256}"}}\n'
        "# cost = sum_i weight_i mean over times of term_i; only ratios matter\n"
        + "".join(parts)
    )


def with_weights(text: str, reward: Reward, file: str) -> str:
    """Return a planner's parameter file with the tuned weights in it.

    Two ways of writing are known, of which everything else in the file is kept:

        NAME: 0.2                                   or NAME = 0.2
        name: [A, NAME, B] with score_weight: [1.0, 0.2, 3.0] of that length

    The second is that of Autoware's trajectory ranker, whose list of metrics is called
    `name`.

    Args:
      text: of the file.
      reward: weights of own terms.
      file: its name, for messages.

    Raises:
      InputError: a term is not there, or more than once.
    """
    tuned = own_weights(reward)
    found: dict[str, list[tuple[int, int]]] = {name: [] for name in tuned}
    for name, spans in found.items():
        line = rf"^[ \t]*(?:- )?[\"']?{re.escape(name)}[\"']?[ \t]*[:=][ \t]*({NUMBER})"
        spans += [one.span(1) for one in re.finditer(line, text, re.MULTILINE)]
    items = lambda key: list(re.finditer(rf"\b{key}[ \t]*:[ \t]*\[([^\]]*)\]", text))  # noqa: E731
    for names, numbers in zip(items("name"), items("score_weight"), strict=False):
        called = [x.strip(" \t\n\"'") for x in names[1].split(",")]
        places = list(re.finditer(NUMBER, numbers[1]))
        if len(called) != len(places):
            raise InputError(
                f"{file}: score_weight: {len(places)} numbers: expected {len(called)}, "
                "one for each name"
            )
        for name, at in zip(called, places, strict=True):
            if name in found:
                start, end = at.span()
                found[name].append((numbers.start(1) + start, numbers.start(1) + end))
    for name, spans in found.items():
        if len(spans) != 1:
            raise InputError(
                f"{file}: {name}: found {len(spans)} times: expected one number of "
                "that name, `name: 0.2`, or its place among `name` and `score_weight`"
            )
    for name, [(start, end)] in sorted(found.items(), key=lambda x: x[1], reverse=True):
        number = _number(tuned[name][1])
        # ROS takes no whole number where it has a list of others
        number += "" if "." in number else ".0"
        text = text[:start] + number + text[end:]
    return text


def terms_table(reward: Reward) -> str:
    """Return the weights of own terms as lines: name, today, tuned, ratio."""
    rows = own_weights(reward)
    wide = max(len(name) for name in (*rows, "own term"))
    lines = [f"{'own term':{wide}}  {'today':>10}  {'tuned':>10}"]
    for name, (today, tuned) in rows.items():
        times = f"x {tuned / today:.2f}"
        lines.append(f"{name:{wide}}  {today:>10.4g}  {tuned:>10.4g}  {times}")
    return "\n".join(lines)


def _number(x: float) -> str:
    """Format seven digits; YAML 1.1 reads an exponent only after a point."""
    text = f"{float(x):.7g}"
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text
