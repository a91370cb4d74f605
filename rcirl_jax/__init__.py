"""Rank-based conditional inverse reinforcement learning for motion planners.

The names below are the public API (docs/api.md). Each is loaded when it is first asked
for: `import rcirl_jax` alone loads no JAX, nor does reading weights.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from rcirl_jax.api.logs import import_logs, read_logs
    from rcirl_jax.api.runs import format_report, gate, rank, simulate, tune
    from rcirl_jax.api.scenes import (
        candidates_from,
        compute_features,
        feature_prices,
        response_curves,
        sample_candidates,
        score_candidates,
        with_predicted_futures,
    )
    from rcirl_jax.api.training import train_reward
    from rcirl_jax.data.store.dataset import open_dataset
    from rcirl_jax.errors import InputError
    from rcirl_jax.export.own_planner.builder import scene_from
    from rcirl_jax.export.own_planner.inputs import Body, Car, CentreLine, Signal
    from rcirl_jax.export.reader import Reward, WeightsError, load_weights

__all__ = [
    "Body",
    "Car",
    "CentreLine",
    "InputError",
    "Reward",
    "Signal",
    "WeightsError",
    "candidates_from",
    "compute_features",
    "feature_prices",
    "format_report",
    "gate",
    "import_logs",
    "load_weights",
    "open_dataset",
    "rank",
    "read_logs",
    "response_curves",
    "sample_candidates",
    "scene_from",
    "score_candidates",
    "simulate",
    "train_reward",
    "tune",
    "with_predicted_futures",
]

# name -> the module that has it
_PLACES = {
    name: place
    for place, names in {
        "api.logs": ("import_logs", "read_logs"),
        "api.training": ("train_reward",),
        "api.runs": ("format_report", "gate", "rank", "simulate", "tune"),
        "api.scenes": (
            *(
                "with_predicted_futures",
                "sample_candidates",
                "candidates_from",
                "compute_features",
            ),
            *("score_candidates", "response_curves", "feature_prices"),
        ),
        "data.store.dataset": ("open_dataset",),
        "errors": ("InputError",),
        "export.own_planner.builder": ("scene_from",),
        "export.own_planner.inputs": ("Body", "Car", "CentreLine", "Signal"),
        "export.reader": ("Reward", "WeightsError", "load_weights"),
    }.items()
    for name in names
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """A name of the API, loaded when it is first asked for."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
