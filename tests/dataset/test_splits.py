"""Splits by seed."""

import pytest

from jaxcrumple.dataset.splits import SPLITS, split_seeds


def test_each_split_has_its_share():
    found = list(split_seeds(range(1000)).values())
    assert [found.count(name) for name in SPLITS] == [800, 100, 100]


@pytest.mark.parametrize("count", [3, 4, 17])
def test_few_seeds_fill_all_splits(count):
    assert set(split_seeds(range(count)).values()) == set(SPLITS)


def test_order_and_repetition_do_not_matter():
    assert split_seeds([5, 3, 9, 3, 5]) == split_seeds([3, 5, 9]) == {3: "train", 5: "test", 9: "validation"}


def test_a_campaign_that_grows_keeps_its_splits():
    few, many = split_seeds(range(7, 30)), split_seeds(range(7, 300))
    assert few == {seed: many[seed] for seed in few}
