import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.store.splits import (
    WHOLES,
    assign_groups,
    split_wholes,
    time_blocks,
)

COUNTS = st.dictionaries(
    st.text(min_size=1, max_size=6), st.integers(1, 500), min_size=2, max_size=30
)
FRACTIONS = st.floats(0.01, 0.99)
SEEDS = st.integers(0, 2**32)


@given(counts=COUNTS, fraction=FRACTIONS, seed=SEEDS)
def test_groups_are_whole_and_shares_off_by_the_largest_at_most(counts, fraction, seed):
    """Every group is in one split, none is empty, the order of the table is nothing."""
    made = assign_groups(counts, test_fraction=fraction, seed=seed)
    assert set(made) == {"train", "test"}
    assert all(made.values())
    assert sorted(made["train"] + made["test"]) == sorted(counts)
    turned = dict(reversed(counts.items()))
    assert assign_groups(turned, test_fraction=fraction, seed=seed) == made
    rows = sum(counts[name] for name in made["test"])
    error = abs(rows - fraction * sum(counts.values()))
    assert error <= max(counts.values()) + 1e-6


@pytest.mark.parametrize(
    ("counts", "fraction", "train", "test"),
    [
        # deficits start at 75 and 25: a 40 -> train (35), b 30 -> train (5),
        # c 20 -> test (5), d 10 -> train, which wins the tie
        ({"d": 10, "b": 30, "a": 40, "c": 20}, 0.25, ("a", "b", "d"), "c"),
        # an empty split takes the smallest group
        ({"a": 9, "b": 7}, 0.01, "a", "b"),
        ({"a": 9, "b": 7}, 0.99, "b", "a"),
    ],
)
def test_against_the_rule_done_by_hand(counts, fraction, train, test):
    made = assign_groups(counts, test_fraction=fraction, seed=0)
    assert made == {"train": list(train), "test": list(test)}


def test_blocks_are_halved_until_none_holds_too_much():
    """Ten scenes each of cars seen at 0, 4, 8 and 50 s: 30 s hold 3/4, 7.5 s 1/2."""
    seen = np.repeat([100.0, 104.0, 108.0, 150.0], 10)
    cars = np.repeat(["a", "b", "c", "d"], 10).tolist()
    blocks, words = time_blocks(seen, cars, 0.25)
    assert blocks == ["block-0000"] * 30 + ["block-0001"] * 10
    assert words == "blocks of 30 s in which vehicles are first seen"
    blocks, words = time_blocks(seen, cars, 0.4)
    assert blocks == [f"block-{n:04d}" for n in (0, 0, 1, 6) for _ in range(10)]
    assert words == "blocks of 7.5 s in which vehicles are first seen"


def test_vehicles_that_are_all_seen_at_once_are_blocks():
    blocks, words = time_blocks(np.zeros(5), ["b", "a", "b", "c", "a"], 0.25)
    assert blocks == [f"block-{n:04d}" for n in (1, 0, 1, 2, 0)]
    assert words == "vehicle, for all are first seen at once"


@given(seed=st.integers(0, 10_000))
def test_a_vehicle_is_in_one_block_only(seed):
    rng = np.random.default_rng(seed)
    since = rng.uniform(0.0, 60.0, 8).round(1)
    car = rng.integers(0, 8, 50)
    blocks, _ = time_blocks(since[car], [f"v{n}" for n in car], 0.25)
    assert all(len({blocks[i] for i in np.flatnonzero(car == n)}) <= 1 for n in car)
    assert (len(set(blocks)) > 1) == (len(set(car)) > 1)


def test_recordings_are_split_whole_and_one_by_its_groups():
    sizes = {"r1/minute-0000": 30, "r1/minute-0001": 10, "r2/minute-0000": 15}
    levels = {name: name[:2] for name in sizes}, {name: name for name in sizes}
    split, words = split_wholes(sizes, levels, test_fraction=0.25, seed=0)
    assert split["test"] == ["r2/minute-0000"]
    assert words == WHOLES
    del sizes["r2/minute-0000"]
    split, words = split_wholes(sizes, levels, test_fraction=0.25, seed=0)
    assert split == {"train": ["r1/minute-0000"], "test": ["r1/minute-0001"]}
    assert words == "minutes in which vehicles are first seen"
