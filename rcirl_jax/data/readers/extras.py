"""Optional packages of the importers, loaded when a format needs them."""

import importlib
from types import ModuleType

from rcirl_jax.errors import InputError


def extra_module(name: str) -> ModuleType:
    """A module of the extra [logs]; one clear line where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"{name}: not installed ({error}): expected pip install 'rcirl-jax[logs]'"
        ) from error
