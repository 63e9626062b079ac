import numpy as np
import oracles_aam as oracles
import pytest
from numpy.testing import assert_allclose

from mmmgpu.components import PART, gram_of, principal_components


def some_rows(count, columns, *, ways=None, seed=0):
    """Rows (S, D) of zero mean that vary in `ways`, each less than the one before."""
    rng = np.random.default_rng(seed)
    ways = min(count - 1, columns) if ways is None else ways
    rows = (
        rng.normal(size=(count, ways)) * 0.7 ** np.arange(ways) @ rng.normal(size=(ways, columns))
    )
    return rows - rows.mean(axis=0)


def assert_same_modes(actual, desired):
    """Equal up to the sign of each."""
    assert_allclose(np.abs((actual * desired).sum(axis=1)), 1, atol=1e-7)


@pytest.mark.parametrize(("count", "columns"), [(2, 5), (6, 40), (12, PART + 3), (20, 5)])
def test_components_are_those_of_a_full_svd(count, columns):
    rows = some_rows(count, columns)
    found = principal_components(gram_of(rows))
    modes, variance = oracles.svd_components(rows)
    rank = min(count - 1, columns)
    assert len(found.variance) == rank
    assert_allclose(found.variance, variance[:rank], rtol=1e-8)
    assert_same_modes(found.modes(rows, rank), modes[:rank])


def test_blocks_side_by_side_are_as_one():
    rows = some_rows(9, 30)
    left, right = rows[:, :11], rows[:, 11:]
    found = principal_components(gram_of(left) + gram_of(right))
    both = np.concatenate([found.modes(left, 4), found.modes(right, 4)], axis=1)
    assert_same_modes(both, oracles.svd_components(rows)[0][:4])


def test_rows_are_made_of_their_modes():
    rows = some_rows(8, 20)
    found = principal_components(gram_of(rows))
    modes = found.modes(rows, len(found.variance))
    assert_allclose(rows @ modes.T @ modes, rows, atol=1e-9)


def test_only_ways_that_there_are_become_components():
    rows = some_rows(10, 50, ways=3)
    assert len(principal_components(gram_of(rows)).variance) == 3
    assert len(principal_components(gram_of(0 * rows)).variance) == 0


def test_the_sign_of_an_axis_does_not_hang_on_chance():
    rows = some_rows(6, 9)
    axes = principal_components(gram_of(rows)).axes
    assert (axes[np.abs(axes).argmax(axis=0), np.arange(axes.shape[1])] > 0).all()


@pytest.mark.parametrize("share", [0.01, 0.5, 0.9, 1.0])
def test_a_share_needs_so_many_components_and_no_fewer(share):
    found = principal_components(gram_of(some_rows(12, 30)))
    count = found.count_for(share)
    assert found.share_of(count) >= share - 1e-12
    assert count == 1 or found.share_of(count - 1) < share
