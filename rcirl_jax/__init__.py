"""Rank-based conditional inverse reinforcement learning for motion planners.

The names below are the public API (docs/api.md). Each is loaded when it is first asked
for: `import rcirl_jax` alone loads no JAX, nor does reading weights.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from rcirl_jax.api.candidates import (
        as_seen,
        candidates_from,
        compute_features,
        sample_candidates,
        score_candidates,
    )
    from rcirl_jax.api.evidence import format_report, gate, rank, simulate
    from rcirl_jax.api.insight import feature_prices, response_curves
    from rcirl_jax.api.learning import train_reward
    from rcirl_jax.api.logs import import_logs, read_logs
    from rcirl_jax.api.tuning import tune
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
    "as_seen",
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
]

# name -> the module that has it
_PLACES = {
    **dict.fromkeys(("read_logs", "import_logs"), "api.logs"),
    "open_dataset": "data.store.dataset",
    "scene_from": "export.own_planner.builder",
    **dict.fromkeys(
        ("Body", "Car", "CentreLine", "Signal"), "export.own_planner.inputs"
    ),
    **dict.fromkeys(("as_seen", "sample_candidates"), "api.candidates"),
    **dict.fromkeys(("candidates_from", "compute_features"), "api.candidates"),
    "score_candidates": "api.candidates",
    "train_reward": "api.learning",
    "tune": "api.tuning",
    **dict.fromkeys(("Reward", "WeightsError", "load_weights"), "export.reader"),
    **dict.fromkeys(("feature_prices", "response_curves"), "api.insight"),
    **dict.fromkeys(("format_report", "gate", "rank", "simulate"), "api.evidence"),
    "InputError": "errors",
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
