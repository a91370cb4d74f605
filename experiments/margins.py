"""The flags that say what the gate takes for a loss and for a gain."""

import dataclasses

from absl import flags

from rcirl_jax.evaluation.gate_types import GateConfig

_PRIMARY = flags.DEFINE_list(
    "primary", list(GateConfig().primary), "metrics that may gain"
)
_MARGINS = {
    name: flags.DEFINE_float(f"{name}_margin", getattr(GateConfig(), name), text)
    for name, text in {
        "collision_free": "largest loss of fault-free cases, share",
        "min_ttc": "of cases above 0.95 s to collision",
        "speed_limit": "of cases within the limit",
        "on_road": "of cases on the road",
        "family_clean": "of the clean drives in one family",
        "progress": "of the incumbent's way",
        "family_progress": "of its way in one family",
    }.items()
}


def gate_config() -> GateConfig:
    """The gate that the flags describe."""
    margins = {name: flag.value for name, flag in _MARGINS.items()}
    primary = tuple(_PRIMARY.value or ())
    return dataclasses.replace(GateConfig(), primary=primary, **margins)
