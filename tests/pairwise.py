"""Covering sets of parameter combinations: some are fast tests, all others slow; and sets that are chosen."""

from collections import Counter
from itertools import combinations, product

import pytest


def covering(strength: int = 2, **values):
    """Parametrize a test with all combinations of values, of which the fewest that cover are fast.

    The search is greedy; of equal combinations it takes the one with the values that were used least.

    Args:
        strength: number of parameters whose combinations of values all occur in fast tests: 2 for pairs, 1 for values.
        values: values of each parameter, by name.
    """
    named = [list(each) for each in values.values()]
    rows = list(product(*(range(len(each)) for each in named)))
    covered = {row: set(combinations(enumerate(row), strength)) for row in rows}
    missing, used, fast = set().union(*covered.values()), Counter(), set()
    while missing:
        row = min(rows, key=lambda row: (-len(covered[row] & missing), sum(used[entry] for entry in enumerate(row))))
        missing -= covered[row]
        used.update(enumerate(row))
        fast.add(row)
    return chosen([tuple(named[k][i] for k, i in enumerate(row)) for row in fast], **values)


def chosen(fast, **values):
    """Parametrize a test with all combinations of values, of which `fast` are fast.

    Args:
        fast: combinations as tuples; of one parameter, its values.
        values: values of each parameter, by name.
    """
    rows, chosen_rows = list(product(*values.values())), [row if len(values) > 1 else (row,) for row in fast]
    assert all(row in rows for row in chosen_rows)
    marks = [() if row in chosen_rows else pytest.mark.slow for row in rows]
    return pytest.mark.parametrize(
        tuple(values), [pytest.param(*row, marks=mark) for row, mark in zip(rows, marks, strict=True)]
    )
