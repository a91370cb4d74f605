"""Several datasets as one, so that a reward learns from all of them."""

import hashlib
from collections.abc import Sequence
from typing import Protocol

import jax
import numpy as np

from rcirl_jax.data.store.dataset import Dataset, open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.types import Demonstration


class Demonstrations(Protocol):
    """What training and export need of a dataset."""

    @property
    def hash(self) -> str:
        """Identity of the whole contents."""
        ...

    def indices(self, split: str | None) -> np.ndarray:
        """Row numbers of a split in ascending order."""
        ...

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Number of the block, unpacked together, that each row lies in."""
        ...

    def load(self, split: str | None) -> Demonstration:
        """All rows of a split in memory."""
        ...

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """[m] float32 weight of each scene in a training loss; 1 in a single source."""
        ...

    def read(self, indices: np.ndarray) -> Demonstration:
        """Rows by number, in the order asked for."""
        ...


class JoinedDatasets:
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
          shares: > 0, one per source; None: every scene weighs 1.

        Raises:
          InputError: another number of shares, or one that is not positive.
        """
        self._parts = tuple(parts)
        self._starts = np.cumsum([0, *(part.count for part in parts)])
        self.shares = None if shares is None else tuple(float(x) for x in shares)
        self._weights = np.ones(len(parts), np.float32)
        if shares is not None:
            given = np.asarray(shares, np.float64)
            if given.shape != (len(parts),) or not np.all(given > 0.0):
                raise InputError(
                    f"data_weights: {list(shares)}: expected {len(parts)} numbers "
                    "> 0, one per source"
                )
            sizes = np.array([part.indices("train").size for part in parts], float)
            each = sizes.sum() / np.maximum(sizes, 1.0) * given / given.sum()
            self._weights = each.astype(np.float32)

    @property
    def parts(self) -> tuple[Dataset, ...]:
        """The sources."""
        return self._parts

    @property
    def hash(self) -> str:
        """sha256 of the parts' hashes in order, and of their shares."""
        text = "\n".join(part.hash for part in self._parts)
        if self.shares is not None:
            text += f"\n{self.shares}"
        return hashlib.sha256(text.encode()).hexdigest()

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """[m] float32 weight of each scene in a training loss."""
        rows = np.asarray(indices, np.int64)
        owner = np.searchsorted(self._starts, rows, side="right") - 1
        return self._weights[owner]

    @property
    def count(self) -> int:
        """Number of rows."""
        return int(self._starts[-1])

    def indices(self, split: str | None) -> np.ndarray:
        """[m] int64 row numbers of a split in ascending order."""
        pairs = zip(self._parts, self._starts[:-1], strict=True)
        return np.concatenate([part.indices(split) + start for part, start in pairs])

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """[m] number of the block of rows, unpacked together, that each lies in."""
        numbers, first = np.empty(indices.size, np.int64), 0
        for part, start in zip(self._parts, self._starts[:-1], strict=True):
            own = part.blocks(np.arange(part.count))
            at = np.flatnonzero((indices >= start) & (indices < start + part.count))
            numbers[at] = first + own[indices[at] - start]
            first += int(own[-1]) + 1
        return numbers

    def load(self, split: str | None) -> Demonstration:
        """All rows of a split (None: of all splits) in memory."""
        return self.read(self.indices(split))

    def read(self, indices: np.ndarray) -> Demonstration:
        """Rows by number, numpy leaves [m, ...], in the order asked for."""
        rows = np.asarray(indices, np.int64)
        owner = np.searchsorted(self._starts, rows, side="right") - 1
        found, places = [], []
        for number in np.unique(owner).tolist():
            at = np.flatnonzero(owner == number)
            found.append(self._parts[number].read(rows[at] - self._starts[number]))
            places.append(at)
        back = np.argsort(np.concatenate(places))
        join = lambda *leaves: np.concatenate(leaves)[back]  # noqa: E731
        return jax.tree.map(join, *found)


EQUAL, SCENES = "equal", "scenes"


def shares_of(text: str, count: int) -> tuple[float, ...] | None:
    """Shares of `count` sources from a flag: "equal", "scenes", or one number each.

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
    """One dataset as it is, or several joined.

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
