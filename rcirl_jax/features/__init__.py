"""The feature map F. Names that need JAX are loaded when they are first asked for.

`columns.py` is F over the arrays of numpy or of JAX, and needs numpy only; `mapping.py`
takes it to scenes and candidates of JAX, with the columns of a preset.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rcirl_jax.features.mapping import FeatureMap, FeatureSpec, feature_map

__all__ = ["FeatureMap", "FeatureSpec", "feature_map"]


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Return a name of `mapping`."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.mapping"), name)
