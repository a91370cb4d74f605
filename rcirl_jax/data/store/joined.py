"""Several datasets as one, so that a reward learns from all of them."""

import hashlib
from collections.abc import Sequence

import jax
import numpy as np

from rcirl_jax.data.store.dataset import Dataset, Demonstrations, open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.types import Demonstration

__all__ = ["Demonstrations", "JoinedDatasets", "open_datasets", "shares_of"]

EQUAL, SCENES = "equal", "scenes"


class JoinedDatasets(Demonstrations):
    """Datasets one after the other; row numbers run on.

    Vehicle, recording and group numbers keep their meaning inside each part
    only, which is enough here: splits are those of the parts.
    """

    def __init__(
        self, parts: Sequence[Dataset], shares: Sequence[float] | None = None
    ) -> None:
        """Join; with `shares` a source counts so much, whatever its number of scenes.

        A training scene of source i then weighs

            w_i = (N / n_i) share_i / sum of shares

        with n_i training scenes of N, so that weights have the mean 1.

        Args:
          parts: the sources.
          shares: > 0, one per source, as of `shares_of`; None: every scene weighs 1.
        """
        self.parts = tuple(parts)
        self._starts = np.cumsum([0, *(part.count for part in parts)])
        self.shares = None if shares is None else tuple(float(x) for x in shares)
        self._weights = np.ones(len(parts), np.float32)
        if shares is not None:
            given = np.asarray(shares, np.float64)
            sizes = np.array([part.indices("train").size for part in parts], float)
            each = sizes.sum() / np.maximum(sizes, 1.0) * given / given.sum()
            self._weights = each.astype(np.float32)

    @property
    def hash(self) -> str:
        """sha256 of the parts' hashes in order, and of their shares."""
        text = "\n".join(part.hash for part in self.parts)
        if self.shares is not None:
            text += f"\n{self.shares}"
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def count(self) -> int:
        """Number of rows."""
        return int(self._starts[-1])

    def _owners(self, indices: np.ndarray) -> np.ndarray:
        rows = np.asarray(indices, np.int64)
        return np.searchsorted(self._starts, rows, side="right") - 1

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """Return the weight [m] float32 of each scene in a training loss."""
        return self._weights[self._owners(indices)]

    def indices(self, split: str | None) -> np.ndarray:
        """Return row numbers [m] int64 of a split (None: of all), ascending."""
        pairs = zip(self.parts, self._starts[:-1], strict=True)
        return np.concatenate([part.indices(split) + start for part, start in pairs])

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Return the number [m] of the block, unpacked together, of each row."""
        numbers, first = np.empty(indices.size, np.int64), 0
        owner = self._owners(indices)
        for number, part in enumerate(self.parts):
            at = owner == number
            numbers[at] = first + part.blocks(indices[at] - self._starts[number])
            first += int(part.blocks(np.array([part.count - 1]))[0]) + 1
        return numbers

    def read(self, indices: np.ndarray) -> Demonstration:
        """Read rows by number, numpy leaves [m, ...], in the order asked for."""
        owner = self._owners(indices)
        found, places = [], []
        for number in np.unique(owner).tolist():
            at = np.flatnonzero(owner == number)
            rows = np.asarray(indices)[at] - self._starts[number]
            found.append(self.parts[number].read(rows))
            places.append(at)
        back = np.argsort(np.concatenate(places))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[back], *found)


def shares_of(text: str, count: int) -> tuple[float, ...] | None:
    """Return shares of `count` sources from "equal", "scenes", or one number each.

    Raises:
      InputError: none of these.
    """
    if text == SCENES or count == 1:
        return None
    if text == EQUAL:
        return (1.0,) * count
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(0.0 < x < np.inf for x in numbers):
        raise InputError(
            f"data_weights: {text}: expected {EQUAL}, {SCENES} or {count} numbers "
            "> 0 with commas, one per source"
        )
    return numbers


def open_datasets(
    urls: Sequence[str], verify: bool = True, weights: str = EQUAL
) -> Dataset | JoinedDatasets:
    """Open one dataset as it is, or several joined.

    Args:
      urls: dataset folders or tensorstore URLs.
      weights: of `shares_of`.
      verify: read every byte against its checksum first.

    Raises:
      InputError: none named, one named twice, or one that does not open.
    """
    if not urls or len(set(urls)) != len(urls):
        raise InputError(f"data: {list(urls)}: expected distinct datasets")
    parts = [open_dataset(url, verify) for url in urls]
    shares = shares_of(weights, len(parts))
    return parts[0] if len(parts) == 1 else JoinedDatasets(parts, shares)
