"""Other splits: disjoint, whole vehicles, nested."""

import types

import numpy as np
import pytest

from rcirl_jax.data.store.splits import (
    HOLDOUTS,
    Resplit,
    folds_by_recording,
    held_out,
    subsample,
    with_tags,
)
from rcirl_jax.errors import InputError
from rcirl_jax.types import Tag


class Rows:
    """A dataset of vehicle and recording numbers only."""

    hash = "rows"

    def __init__(self):
        rng = np.random.default_rng(0)
        self.vehicle = np.repeat(np.arange(40), 5)
        self.recording = self.vehicle // 10
        self.recording[50:52] = 0  # vehicle 10 goes on from one recording to the next
        self.group = self.vehicle // 2
        self.beside = (self.vehicle + 1) % 40  # the obstacle of each scene
        self.test = np.flatnonzero(np.isin(self.vehicle, rng.permutation(40)[:8]))

    def indices(self, split):
        every = np.arange(self.vehicle.size)
        if split is None:
            return every
        return self.test if split == "test" else np.setdiff1d(every, self.test)

    def read(self, rows):
        names = ("vehicle", "recording", "group", "beside")
        return type("Rows", (), {name: getattr(self, name)[rows] for name in names})

    def load(self, split):
        return self.read(self.indices(split))


@pytest.mark.parametrize("how", HOLDOUTS)
def test_what_is_held_out(how):
    split, words = held_out(Rows(), how, recordings=[1, 3])
    assert words != "as imported" or how == "groups"
    train, test = split.load("train"), split.load("test")
    assert not set(train.vehicle) & set(test.vehicle)
    # who is held out may be an obstacle of the others
    assert set(train.beside) & set(test.vehicle)
    assert set(test.beside) & set(train.vehicle)
    unseen = np.isin(split.indices(None), Rows().test).sum()
    if how == "validation":  # to choose by: the scenes to judge by are in neither part
        assert unseen == 0
        assert 15 <= test.vehicle.size <= 60
    elif how == "groups":
        np.testing.assert_array_equal(split.indices("test"), Rows().test)
    elif how == "recording":
        assert set(test.recording) == {1, 3}
    else:
        assert np.unique(test.vehicle).size == 10
        assert not np.isin(split.indices("test"), Rows().test).all()


def test_fewer_is_nested_and_keeps_the_test_rows():
    few, more = subsample(Rows(), 20, 0), subsample(Rows(), 60, 0)
    assert few.indices("train").size == 20
    assert set(few.indices("train")) <= set(more.indices("train"))
    assert np.unique(few.load("train").vehicle).size == 4
    np.testing.assert_array_equal(few.indices("test"), Rows().test)


def test_overlap_and_nothing_are_refused():
    with pytest.raises(InputError, match="in two splits"):
        Resplit(Rows(), {"train": np.array([1, 2]), "test": np.array([2])})
    with pytest.raises(InputError, match="test: no rows"):
        Resplit(Rows(), {"train": np.array([1, 2]), "test": np.array([], int)})


def test_folds_hold_out_every_scene_once():
    data = Rows()
    folds = folds_by_recording(data, 3)  # of four recordings with 52, 48, 50, 50 scenes
    held = np.concatenate([fold.indices("test") for fold in folds])
    np.testing.assert_array_equal(np.sort(held), data.indices(None))
    assert sorted(fold.indices("test").size for fold in folds) == [50, 52, 98]
    for fold in folds:
        train, test = fold.load("train"), fold.load("test")
        assert not set(train.vehicle) & set(test.vehicle)
        assert not set(train.recording) & set(test.recording)


class Tagged(Rows):
    """Every third scene changes lanes; in two training scenes somebody cuts in."""

    def read(self, rows):
        tags = np.zeros((self.vehicle.size, len(Tag)), bool)
        tags[::3, Tag.LANE_CHANGE] = True
        tags[self.indices("train")[:2], Tag.CUT_IN] = True
        return types.SimpleNamespace(scene=types.SimpleNamespace(tags=tags[rows]))


def test_scenes_with_a_tag():
    data = Tagged()
    assert with_tags(data, []) is data
    found = with_tags(data, ["lane_change"])
    for split in ("train", "test"):
        rows = data.indices(split)
        assert found.indices(split).tolist() == rows[rows % 3 == 0].tolist()
    both = with_tags(data, ["lane_change", "cut_in"]).indices("train")
    assert set(found.indices("train")) < set(both)
    assert set(data.indices("train")[:2]) <= set(both)
    assert found.hash != data.hash
