"""Another split of the same scenes: by vehicle, by recording, or smaller.

A vehicle is held out as the ego: the scenes of which it is the ego leave the training
scenes. It may still be an obstacle in a training scene, with its recorded future, and
a training ego one in a held-out scene. Rows keep their numbers, and so their
candidates.
"""

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.data.store.splits import TEST, TRAIN, assign_groups
from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.types import Demonstration, Tag

HOLDOUTS = ("groups", "vehicles", "recording", "validation")
HELD_OUT = 0.25  # share of the vehicles, or of the training scenes


class Resplit(Demonstrations):
    """A dataset seen through other splits.

    Args:
      dataset: any dataset.
      splits: name -> row numbers; a row may be in one split at most.
    """

    def __init__(
        self, dataset: Demonstrations, splits: Mapping[str, np.ndarray]
    ) -> None:
        self._dataset = dataset
        self._splits = {
            name: np.unique(np.asarray(rows, np.int64)) for name, rows in splits.items()
        }
        total = np.concatenate(list(self._splits.values()))
        if np.unique(total).size != total.size:
            raise InputError("split: rows: one is in two splits: expected one split")
        for name, rows in self._splits.items():
            if rows.size == 0:
                raise InputError(f"split: {name}: no rows: expected at least one")

    @property
    def hash(self) -> str:
        """sha256 of the dataset's hash and the rows of every split."""
        text = hashlib.sha256(self._dataset.hash.encode())
        for name in sorted(self._splits):
            text.update(name.encode() + self._splits[name].tobytes())
        return text.hexdigest()

    def indices(self, split: str | None) -> np.ndarray:
        """Return row numbers [m] of a split (None: of all), ascending."""
        if split is None:
            return np.sort(np.concatenate(list(self._splits.values())))
        return self._splits[split]

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Return the number [m] of the block, unpacked together, of each row."""
        return self._dataset.blocks(indices)

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """Return the weight [m] float32 of each scene in a training loss."""
        return self._dataset.weights(indices)

    def read(self, indices: np.ndarray) -> Demonstration:
        """Read rows by number, in the order asked for."""
        return self._dataset.read(indices)


def by_recording(dataset: Demonstrations, recordings: Sequence[int]) -> Resplit:
    """Hold out recordings; scenes of their egos elsewhere leave training too.

    Such an ego may still be an obstacle in a training scene, with its recorded
    future, and a training ego one in a held-out scene.

    Raises:
      InputError: none is named, or one has no scene.
    """
    every = dataset.load(None)
    vehicle, where = np.asarray(every.vehicle), np.asarray(every.recording)
    found, named = np.unique(where), list(recordings)
    if not named or not np.isin(named, found).all():
        known = ", ".join(map(str, found))
        raise InputError(f"recording: {named}: expected of {known}")
    held = np.isin(where, named)
    clear = ~np.isin(vehicle, vehicle[held])
    rows = dataset.indices(None)
    return Resplit(dataset, {"train": rows[clear], "test": rows[held]})


def folds_by_recording(dataset: Demonstrations, count: int) -> list[Resplit]:
    """Hold every scene out once: recordings dealt into parts, one held out at a time.

    The largest recording first, each to the part with fewest scenes. As in
    `by_recording`, the ego of a held-out scene is that of no training scene, but may
    be an obstacle there, with its recorded future; and the reverse.

    Args:
      dataset: any dataset; its own split does not matter.
      count: of parts, at least 2.

    Raises:
      InputError: fewer recordings than parts, or a part whose egos are those of all
        other scenes.
    """
    where = np.asarray(dataset.load(None).recording)
    names, sizes = np.unique(where, return_counts=True)
    if not 2 <= count <= names.size:
        raise InputError(
            f"folds: {count}: expected 2 to {names.size}, recordings with scenes"
        )
    parts: list[list[int]] = [[] for _ in range(count)]
    held = np.zeros(count, np.int64)
    for at in np.argsort(-sizes, kind="stable"):
        least = int(np.argmin(held))
        parts[least].append(int(names[at]))
        held[least] += sizes[at]
    return [by_recording(dataset, sorted(part)) for part in parts]


def with_tags(dataset: Demonstrations, names: Sequence[str]) -> Demonstrations:
    """Keep the scenes with one of these tags; all of them without a name.

    Args:
      dataset: any dataset with splits "train" and "test".
      names: of `Tag`, in small letters.

    Raises:
      InputError: an unknown tag, or a split in which no scene has one.
    """
    if not names:
        return dataset
    known = [tag.name.lower() for tag in Tag]
    for name in names:
        if name not in known:
            raise InputError(
                f"tags: {name}: expected some of {', '.join(known)}"
                + did_you_mean(name, known)
            )
    numbers = [known.index(name) for name in names]
    splits = {}
    for split in (TRAIN, TEST):
        tags = np.asarray(dataset.load(split).scene.tags)
        chosen = tags[:, numbers].any(axis=1)
        splits[split] = dataset.indices(split)[chosen]
        if tags.size and not chosen.any():
            raise InputError(
                f"tags: {', '.join(names)}: none of {len(tags)} scenes of the split "
                f"{split} has one: expected at least one"
            )
    return Resplit(dataset, {k: rows for k, rows in splits.items() if rows.size})


def subsample(dataset: Demonstrations, count: int, seed: int) -> Resplit:
    """Keep the test split, and `count` training scenes drawn by vehicle.

    Whole vehicles are taken in a drawn order until the count is reached, so
    that few scenes also means few drivers; nested: more scenes contain fewer.
    """
    rows = dataset.indices("train")
    vehicle = np.asarray(dataset.load("train").vehicle)
    order = np.random.default_rng([seed, 23]).permutation(np.unique(vehicle))
    place = np.empty(int(vehicle.max()) + 1, np.int64)
    place[order] = np.arange(order.size)
    taken = np.argsort(place[vehicle], kind="stable")[:count]
    return Resplit(dataset, {"train": rows[taken], "test": dataset.indices("test")})


def with_validation(
    dataset: Demonstrations, share: float, seed: int
) -> tuple[Resplit, str]:
    """Cut the training split into scenes to fit and scenes to choose by.

    By vehicle-disjoint group, if that holds out between half and twice the share
    and at least two vehicles; else, as where one group holds nearly all scenes, by
    vehicle. Either way those held out may be obstacles in scenes of the fit. Equal
    numbers in joined datasets are taken for one vehicle or group, which never puts
    one on both sides.

    Args:
      dataset: any dataset with a test split, which stays as it is.
      share: of the training scenes, wanted for validation.
      seed: of the order among groups or vehicles of one size.

    Returns:
      (splits "train", "validation", "test"; "group" or "vehicle").

    Raises:
      InputError: the training split has fewer than three vehicles.
    """
    rows, own = dataset.indices(TRAIN), dataset.load(TRAIN)
    vehicle = np.asarray(own.vehicle)
    if np.unique(vehicle).size < 3:
        raise InputError(
            f"split: {TRAIN}: {np.unique(vehicle).size} vehicles: expected at least 3,"
            " of which some are held out to choose by"
        )
    held, by = np.zeros(rows.size, bool), ""
    for by in ("group", "vehicle"):
        number = np.asarray(getattr(own, by))
        names, counts = np.unique(number, return_counts=True)
        if names.size < 2:
            continue
        sizes = dict(zip(map(str, names), counts.tolist(), strict=True))
        parts = assign_groups(sizes, test_fraction=share, seed=seed)
        held = np.isin(number, [int(name) for name in parts[TEST]])
        enough = 0.5 * share <= held.mean() <= 2.0 * share
        if enough and np.unique(vehicle[held]).size > 1:
            break
    splits = {TRAIN: rows[~held], "validation": rows[held], TEST: dataset.indices(TEST)}
    return Resplit(dataset, splits), by


def held_out(
    dataset: Demonstrations,
    how: str,
    *,
    seed: int = 0,
    recordings: Sequence[int] = (0,),
) -> tuple[Demonstrations, str]:
    """Split the dataset anew, as one of `HOLDOUTS` says.

    groups leaves the dataset's split; vehicles holds out `HELD_OUT` of the egos;
    recording holds out some; validation holds out `HELD_OUT` of the training scenes
    and leaves the dataset's test scenes unseen, so that a learner can be chosen.

    Returns:
      The dataset, and in words how it is split.
    """
    if how == "vehicles":
        # they may still be obstacles in training scenes, with their recorded future
        vehicle, rows = np.asarray(dataset.load(None).vehicle), dataset.indices(None)
        known = np.unique(vehicle)
        drawn = np.random.default_rng([seed, 17]).permutation(known)
        held = np.isin(vehicle, drawn[: max(round(HELD_OUT * known.size), 1)])
        splits = {TRAIN: rows[~held], TEST: rows[held]}
        return Resplit(dataset, splits), f"vehicles, seed {seed}"
    if how == "recording":
        named = ", ".join(map(str, recordings))
        return by_recording(dataset, recordings), f"recording {named}"
    if how == "validation":
        parts, by = with_validation(dataset, HELD_OUT, seed)
        splits = {TRAIN: parts.indices(TRAIN), TEST: parts.indices("validation")}
        return Resplit(dataset, splits), f"validation by {by}, seed {seed}"
    return dataset, "as imported"
