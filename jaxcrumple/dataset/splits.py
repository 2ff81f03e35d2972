"""Split runs into training, validation and test by their seeds."""

from collections.abc import Iterable

#: Of each ten seeds in ascending order, the second is for the test and the third for validation.
PATTERN = ("train", "test", "validation", *["train"] * 7)
SPLITS = ("train", "validation", "test")


def split_seeds(seeds: Iterable[int]) -> dict[int, str]:
    """Return the split of each seed: of many seeds, 80 % train, 10 % validation and 10 % test.

    The split of a seed depends only on its rank, so a campaign that grows by larger seeds keeps the splits of
    the others. Three seeds suffice for three splits.
    """
    return {seed: PATTERN[rank % len(PATTERN)] for rank, seed in enumerate(sorted(set(seeds)))}
