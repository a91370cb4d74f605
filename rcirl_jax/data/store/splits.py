"""Splits by vehicle-disjoint group, never by row.

Rows of one drive resemble each other: with rows of one vehicle on both sides a
held-out score measures memory. A group holds every row of the vehicles that are the
ego of one, so splitting groups splits egos (an ego here may be an obstacle there,
unless the groups given forbid it). The result depends on names, counts and seed
only: ties and the "random" order come from sha256, which is the same on every
machine, Python and numpy.
"""

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.errors import InputError

TRAIN = "train"
TEST = "test"
LONGEST_BLOCK_S = 30.0  # s, half of the minute that a group usually is
SHORTEST_BLOCK_S = 0.1  # s, about a frame


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


def split_wholes(
    sizes: Mapping[str, int],
    wholes: Mapping[str, str],
    *,
    test_fraction: float,
    seed: int,
) -> tuple[dict[str, list[str]], str]:
    """`assign_groups` of whole recordings, or of their groups where there is only one.

    Args:
      sizes: rows per group.
      wholes: of each group the recording that it is a part of, or the group itself.
      test_fraction: share of rows wanted in the test split.
      seed: as there.

    Returns:
      (group names per split; in words what is kept on one side).
    """
    counts: dict[str, int] = {}
    for group, rows in sizes.items():
        counts[wholes[group]] = counts.get(wholes[group], 0) + rows
    is_one = len(counts) == 1
    chosen = assign_groups(
        sizes if is_one else counts, test_fraction=test_fraction, seed=seed
    )
    splits = {
        split: sorted(g for g in sizes if (g if is_one else wholes[g]) in names)
        for split, names in chosen.items()
    }
    words = "minutes in which vehicles are first seen"
    return splits, words if is_one else "recordings, or groups that a log declares"


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
