"""Linear costs as YAML for planners whose cost is linear in named terms.

A linear reward, free or non-negative, is exact in `features`:

    cost = sum_t gamma_t sum_i   above_i max(f_i - usual_i, 0)
                               + below_i max(usual_i - f_i, 0)

f_i clipped to [lower_i, upper_i]; costs are per unit of the feature. `frenetix` names
the nearest terms of that planner's cost.yaml. Its terms are integrals of squares or
of absolute values over seconds, so the weights are matched where a feature departs from
the usual by its spread: a start for its planner, not the same cost. A free linear
reward has none: it wants more of a feature or less, never the usual.
"""

from collections.abc import Mapping

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export.reader import Reward

SCHEMA = "rcirl-jax/linear-cost"
SCHEMA_VERSION = 1

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
    if (
        len(kernels) != 2
        or reward.activation != "relu"
        or not alone.all()
        or np.any(reward.biases[0])
    ):
        raise InputError(f"{where}: {len(kernels)}: expected a linear reward")
    parts = -first * last[:, 0]  # [F, H] cost of a unit per scaled feature
    above = np.sum(np.where(first > 0.0, parts, 0.0), axis=1) / scale
    below = np.sum(np.where(first < 0.0, -parts, 0.0), axis=1) / scale
    return above, below


def reward_yaml(reward: Reward) -> str:
    """Return the document of a linear reward."""
    above, below = linear_costs(reward)
    lines = _head({"weights_sha256": reward.sha256, "preset": reward.preset})
    lines += [
        "# cost = sum_t gamma_t sum_i above_i max(f_i - usual_i, 0)"
        " + below_i max(usual_i - f_i, 0)",
        f"times_s: {_list(reward.times)}",
        f"gamma: {_list(reward.gamma)}",
        "features:",
    ]
    for i, name in enumerate(reward.names):
        facts = {
            "unit": f'"{reward.units[i]}"',
            "usual": _number(reward.location[i]),
            "lower": _number(reward.lower[i]),
            "upper": _number(reward.upper[i]),
            "above": _number(above[i]),
            "below": _number(below[i]),
        }
        body = ", ".join(f"{key}: {value}" for key, value in facts.items())
        lines.append(f"  {name}: {{{body}}}")
    if len(reward.kernels) == 1:
        # a free linear reward wants more of a feature or less, never the usual: a
        # cost of departures, as Frenetix has them, cannot say so
        return "\n".join(lines) + "\n"
    lines += [
        "# nearest terms of Frenetix's cost.yaml, matched at one spread of the",
        "# feature: a start for its planner, not the same cost",
        "frenetix:",
        "  cost_weights:",
    ]
    weights = _frenetix(reward, above, below)
    lines += [f"    {name}: {_number(weights[name])}" for name in weights]
    return "\n".join(lines) + "\n"


def _frenetix(reward: Reward, above: np.ndarray, below: np.ndarray) -> dict[str, float]:
    step = float(np.mean(np.diff(reward.times)))
    # its terms are integrals over seconds, ours sums over times
    per_second = float(np.mean(reward.gamma)) / step
    found = dict.fromkeys((*FRENETIX, *FRENETIX_NONE), 0.0)
    for name, (feature, power) in FRENETIX.items():
        if feature in reward.names:
            i = reward.names.index(feature)
            cost = max(0.5 * float(above[i] + below[i]), 0.0)
            found[name] = cost * per_second / float(reward.scale[i]) ** (power - 1)
    return found


def _head(source: Mapping[str, str]) -> list[str]:
    facts = ", ".join(f'{key}: "{value}"' for key, value in source.items())
    return [
        f"schema: {SCHEMA}",
        f"schema_version: {SCHEMA_VERSION}",
        f"source: {{{facts}}}",
    ]


def _number(value: float) -> str:
    """Format seven digits; YAML 1.1 reads an exponent only after a point."""
    text = f"{float(value):.7g}"
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text


def _list(values: np.ndarray) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"
