"""Fewer combinations of parameters: every pair of values is among them, and hardly any row is there for nothing."""

import itertools

import pytest
from helpers import pairwise


@pytest.mark.parametrize("sizes", [(2, 2), (3, 3, 3), (3, 3, 3, 3), (2, 5, 3, 4), (5, 1, 2), (1, 1)])
def test_every_pair_of_values_meets(sizes):
    lists = [[f"{'abcd'[k]}{n}" for n in range(size)] for k, size in enumerate(sizes)]
    rows = pairwise(*lists)
    for one, other in itertools.combinations(range(len(sizes)), 2):
        assert {(row[one], row[other]) for row in rows} == {*itertools.product(lists[one], lists[other])}
    least = max(a * b for a, b in itertools.combinations(sizes, 2))
    assert least <= len(rows) <= 1.5 * least and len({*rows}) == len(rows)
    assert rows == pairwise(*lists)


def test_two_lists_are_their_product():
    assert sorted(pairwise("ab", "xyz")) == sorted(itertools.product("ab", "xyz"))
