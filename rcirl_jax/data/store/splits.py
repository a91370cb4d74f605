"""Splits by vehicle-disjoint group, never by row.

Rows of one drive resemble each other: with rows of one vehicle on both sides a
held-out score measures memory. A group holds every row of the vehicles that are the
ego of one, so splitting groups splits egos (an ego here may be an obstacle there,
unless the groups given forbid it). The result depends on names, counts and seed
only: ties and the "random" order come from sha256, which is the same on every
machine, Python and numpy.

The second half splits the scenes of a dataset anew, by vehicle or recording, or takes
fewer. A vehicle is held out as the ego there too: with its recorded future it may be an
obstacle in a training scene, and a training ego one in a held-out scene. Rows keep
their numbers, and so their candidates.
"""

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.types import Demonstration, Tag

TRAIN = "train"
TEST = "test"
LONGEST_BLOCK_S = 30.0  # s, half of the minute that a group usually is
SHORTEST_BLOCK_S = 0.1  # s, about a frame
HOLDOUTS = ("groups", "vehicles", "recording", "validation")
HELD_OUT = 0.25  # share of the vehicles, or of the training scenes


def assign_groups(
    counts: Mapping[str, int], *, test_fraction: float, seed: int
) -> dict[str, list[str]]:
    """Assign whole groups to the training and the test split.

    Largest group first, each to the split that still lacks most rows:
    deficit = share * total - rows it has; the training split wins ties. Where
    a split stays empty, it takes the smallest group.

    Args:
      counts: rows per group, each at least 1.
      test_fraction: share of rows wanted in the test split, 0 <= f < 1.
      seed: of the random order among groups of one size.

    Returns:
      {"train": names, "test": names}, sorted; every group in exactly one. With
      `test_fraction` 0 the test split is empty.

    Raises:
      InputError: no group, one group to be split in two, or a bad fraction.
    """
    if not 0.0 <= test_fraction < 1.0:
        raise InputError(f"test_fraction: {test_fraction}: expected 0 <= f < 1")
    if not counts:
        raise InputError("splits: groups: 0: expected at least one group of scenes")
    if test_fraction == 0.0:
        return {TRAIN: sorted(counts), TEST: []}
    if len(counts) < 2:
        raise InputError(
            f"splits: groups: 1 ({next(iter(counts))}): expected at least two "
            f"vehicle-disjoint groups for test_fraction {test_fraction}"
        )
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"group {name}: {count} rows: expected at least 1")
    shuffled = sorted(
        counts, key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest()
    )
    order = sorted(shuffled, key=lambda name: -counts[name])  # stable
    total = sum(counts.values())
    deficit = {TRAIN: (1.0 - test_fraction) * total, TEST: test_fraction * total}
    chosen: dict[str, list[str]] = {TRAIN: [], TEST: []}
    for name in order:
        split = TRAIN if deficit[TRAIN] >= deficit[TEST] else TEST
        chosen[split].append(name)
        deficit[split] -= counts[name]
    for empty, other in ((TRAIN, TEST), (TEST, TRAIN)):
        if not chosen[empty]:
            chosen[empty].append(chosen[other].pop())  # the smallest comes last
    return {split: sorted(names) for split, names in chosen.items()}


WHOLES = "whole recordings, or groups that the log declares; each is in one split"


def split_wholes(
    sizes: Mapping[str, int],
    levels: tuple[Mapping[str, str], Mapping[str, str]],
    *,
    test_fraction: float,
    seed: int,
) -> tuple[dict[str, list[str]], str]:
    """`assign_groups` of whole recordings, or of their groups where there is only one.

    Args:
      sizes: rows per group.
      levels: of each group the name of the recordings, and of the groups, that stay on
        one side with it; the first counts if there are several names.
      test_fraction: share of rows wanted in the test split.
      seed: as there.

    Returns:
      (group names per split; in words what is kept on one side).
    """
    is_one = len({levels[0][group] for group in sizes}) == 1
    wholes = levels[is_one]
    counts: dict[str, int] = {}
    for group, rows in sizes.items():
        counts[wholes[group]] = counts.get(wholes[group], 0) + rows
    chosen = assign_groups(counts, test_fraction=test_fraction, seed=seed)
    splits = {
        split: sorted(group for group in sizes if wholes[group] in names)
        for split, names in chosen.items()
    }
    words = "minutes in which vehicles are first seen"
    return splits, words if is_one else WHOLES


def time_blocks(
    first_seen: np.ndarray, vehicles: Sequence[str], test_fraction: float
) -> tuple[list[str], str]:
    """Cut the vehicles of one group into groups by when they were first seen.

    Blocks of 30 s, halved until none holds more scenes than the training split is
    to have; if there is no such length, the longest whose largest block is smallest.
    Where all vehicles are first seen at once each is a block of its own.

    Args:
      first_seen: [n] s, of each scene's vehicle; one value per vehicle.
      vehicles: [n] names.
      test_fraction: share of scenes wanted in the test split.

    Returns:
      (block of each scene, e.g. "block-0003"; in words what a block is).
    """
    since = np.asarray(first_seen, np.float64) - np.min(first_seen)
    least, length, number = np.inf, 0.0, np.zeros(since.size, int)
    shorter = LONGEST_BLOCK_S
    while shorter > SHORTEST_BLOCK_S and least > 1.0 - test_fraction:
        found = np.floor(since / shorter + 1e-6).astype(int)
        most = np.bincount(found).max() / since.size
        if most < least:
            least, length, number = most, shorter, found
        shorter *= 0.5
    words = f"blocks of {length:g} s in which vehicles are first seen"
    if np.unique(number).size == 1:
        number = np.unique(vehicles, return_inverse=True)[1].reshape(-1)
        words = "vehicle, for all are first seen at once"
    return [f"block-{block:04d}" for block in number.tolist()], words


def check_disjoint(
    groups: np.ndarray, vehicles: np.ndarray, split: Mapping[str, Sequence[int]]
) -> None:
    """Check that no vehicle has rows in two splits.

    Args:
      groups: [n] group number per row.
      vehicles: [n] vehicle number per row.
      split: group numbers of each split, e.g. {"train": [0, 2], "test": [1]}.

    Raises:
      InputError: names the first vehicle number found in two splits.
    """
    owner: dict[int, str] = {}
    for name, members in split.items():
        rows = np.isin(groups, np.asarray(members, np.int64))
        for vehicle in np.unique(vehicles[rows]).tolist():
            if vehicle in owner:
                raise InputError(
                    f"splits: vehicle {vehicle}: in {owner[vehicle]} and {name}: "
                    "expected every vehicle in one split only"
                )
            owner[vehicle] = name


# ----------------------------------------------------------- other splits of a dataset


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
        """Returns row numbers [m] of a split (None: of all), ascending."""
        if split is None:
            return np.sort(np.concatenate(list(self._splits.values())))
        return self._splits[split]

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Returns the number [m] of the block, unpacked together, of each row."""
        return self._dataset.blocks(indices)

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """Returns the weight [m] float32 of each scene in a training loss."""
        return self._dataset.weights(indices)

    def read(self, indices: np.ndarray) -> Demonstration:
        """Reads rows by number, in the order asked for."""
        return self._dataset.read(indices)


def by_recording(dataset: Demonstrations, recordings: Sequence[int]) -> Resplit:
    """Holds out recordings; scenes of their egos elsewhere leave training too.

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
    """Holds every scene out once: recordings dealt into parts, one held out at a time.

    The largest recording first, each to the part with fewest scenes.

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
    """Keeps the scenes with one of these tags; all of them without a name.

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
    """Keeps the test split, and `count` training scenes drawn by vehicle.

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
    """Cuts the training split into scenes to fit and scenes to choose by.

    By vehicle-disjoint group, if that holds out between half and twice the share
    and at least two vehicles; else, as where one group holds nearly all scenes, by
    vehicle. Equal numbers in joined datasets are taken for one vehicle or group, which
    never puts one on both sides.

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
    """Splits the dataset anew, as one of `HOLDOUTS` says.

    groups leaves the dataset's split; vehicles holds out `HELD_OUT` of the egos;
    recording holds out some; validation holds out `HELD_OUT` of the training scenes
    and leaves the dataset's test scenes unseen, so that a learner can be chosen.

    Returns:
      The dataset, and in words how it is split.
    """
    if how == "vehicles":
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
