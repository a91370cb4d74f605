"""What a file says of its making, checked before anything is done with it."""

from collections.abc import Mapping
from typing import Any

from rcirl_jax.errors import InputError

# types of the entries that are used; None stands for "not said"
TYPES: dict[str, type] = {
    **dict.fromkeys(("seed", "steps"), int),
    **dict.fromkeys(("git_commit", "dataset_sha256", "created", "mode"), str),
    **dict.fromkeys(("flags", "metrics", "versions", "config", "sweep"), dict),
}


def check_provenance(found: Mapping[str, Any], file: str) -> None:
    """Check the entries that this package uses; others may be anything.

    Raises:
      InputError: one is of another type (names file, entry and value).
    """
    for name, kind in TYPES.items():
        value = found.get(name)
        if value is not None and type(value) is not kind:
            raise InputError(
                f"{file}: provenance.{name}: {value}: expected {kind.__name__} or none"
            )


def dataset_names(found: object, where: str) -> list[str]:
    """Datasets that a run's flags name: one, or a list.

    Raises:
      InputError: anything else, or a name that no file can have.
    """
    names = found if isinstance(found, list) else [found]
    texts = [name for name in names if isinstance(name, str) and name.strip("\0")]
    if not names or len(texts) != len(names) or any("\0" in name for name in texts):
        raise InputError(f"{where}: {found}: expected a dataset, or a list of them")
    return texts
