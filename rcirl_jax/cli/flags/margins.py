"""The gate: what it takes for a loss and for a gain."""

import dataclasses

from absl import flags

from rcirl_jax.evaluation.gate.types import GateConfig

_PRIMARY = flags.DEFINE_list(
    "primary",
    list(GateConfig().primary),
    "metrics of which one has to gain; docs/gate.md lists them",
)
_ACCEPT = flags.DEFINE_list(
    "accept", [], "ids of cases whose new fault a person has looked at, as cut_in/017@0"
)
_MARGINS = {
    name: flags.DEFINE_float(f"{name}_margin", getattr(GateConfig(), name), text)
    for name, text in {
        "collision": "more cases with a preventable at-fault collision, share",
        "vulnerable": "with a pedestrian or cyclist hit",
        "red_light": "with a red light run",
        "stop_sign": "with a stop sign run",
        "collision_free": "largest loss of fault-free cases, share",
        "min_ttc": "of cases above 0.95 s to collision",
        "speed_limit": "of cases within the limit",
        "on_road": "of cases on the road",
        "family_clean": "of the clean drives in one family",
        "progress": "of the incumbent's progress",
        "family_progress": "of its progress in one family",
        "gain": "of one primary metric, whatever is gained in another",
    }.items()
}


def gate_config() -> GateConfig:
    """The gate that the flags describe."""
    return dataclasses.replace(
        GateConfig(),
        primary=tuple(_PRIMARY.value or ()),
        accept=tuple(_ACCEPT.value or ()),
        **{name: flag.value for name, flag in _MARGINS.items()},
    )
