from math import comb, log

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles_study import bradley_terry_by_search, holm_by_hand, two_sided_by_counting

from mmmgpu.study_statistics import bradley_terry, exact_shares, has_scale, holm, sign_test

# Table 1 of the paper, decided answers: brand, dpds, reality, slds
PAPER = np.array([[0, 5, 4, 36], [54, 0, 29, 60], [55, 26, 0, 58], [9, 1, 3, 0]])


@pytest.mark.parametrize("n", [1, 2, 7, 12])
def test_binomial_test_is_that_of_all_outcomes(n):
    for k in range(n + 1):
        assert_allclose(exact_shares(k, n - k).p, two_sided_by_counting(k, n), rtol=1e-12, atol=0)


def test_interval_holds_what_its_ends_make_just_likely():
    shares = exact_shares(7, 3)
    assert shares.share == 0.7

    def upper_tail(p):
        return sum(comb(10, k) * p**k * (1 - p) ** (10 - k) for k in range(7, 11))

    def lower_tail(p):
        return sum(comb(10, k) * p**k * (1 - p) ** (10 - k) for k in range(8))

    assert_allclose(upper_tail(shares.low), 0.025, rtol=1e-9, atol=0)
    assert_allclose(lower_tail(shares.high), 0.025, rtol=1e-9, atol=0)


def test_no_choices_say_nothing():
    shares = exact_shares(0, 0)
    assert (shares.share, shares.low, shares.high, shares.p) == (None, None, None, 1.0)


def test_sign_test_drops_ties():
    shares = sign_test([2, 1, 0, 0, -1, 2, 1, 2])
    assert (shares.first, shares.second) == (5, 1)
    assert shares.p == pytest.approx(2 * (6 + 1) / 2**6)


def test_holm():
    p = np.array([0.01, 0.04, 0.03, 0.005, 0.9])
    assert_allclose(holm(p), [0.04, 0.09, 0.09, 0.025, 0.9], rtol=1e-12, atol=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        p = rng.random(6) ** 3
        assert_allclose(holm(p), holm_by_hand(p), rtol=1e-12, atol=0)
    assert holm([]).shape == (0,)


def test_two_conditions_have_a_closed_form():
    scale = bradley_terry([[0, 30], [10, 0]])
    assert_allclose(scale.theta, [log(3) / 2, -log(3) / 2], rtol=1e-9, atol=0)
    # of the difference: 1/30 + 1/10; each end is half of it
    assert_allclose(np.diag(scale.covariance), (1 / 30 + 1 / 10) / 4, rtol=1e-9, atol=0)
    low, high = scale.intervals()
    assert_allclose((high - low) / 2, 1.959964 * np.sqrt((1 / 30 + 1 / 10) / 4), rtol=1e-6, atol=0)


@pytest.mark.parametrize("seed", range(5))
def test_scale_has_the_greatest_likelihood(seed):
    rng = np.random.default_rng(seed)
    wins = rng.integers(1, 40, (4, 4)) * (1 - np.eye(4, dtype=int))
    wins[0] *= 8
    scale = bradley_terry(wins)
    theta, covariance = bradley_terry_by_search(wins)
    assert_allclose(scale.theta, theta, rtol=0, atol=1e-5)
    assert_allclose(scale.covariance, covariance, rtol=1e-3, atol=1e-7)
    assert_allclose(scale.theta.sum(), 0, rtol=0, atol=1e-12)


def test_far_apart_conditions_are_found():
    wins = np.array([[0, 1000, 0], [1, 0, 1000], [0, 1, 0]])
    scale = bradley_terry(wins)
    assert_allclose(np.diff(scale.theta), [-log(1000), -log(1000)], rtol=1e-8, atol=0)


def test_the_paper_table_gives_the_paper_order():
    scale = bradley_terry(PAPER)
    brand, dpds, reality, slds = scale.theta
    assert slds < brand < reality
    low, high = scale.intervals()
    assert high[3] < low[0]
    assert high[0] < low[1]
    assert high[0] < low[2]
    assert low[1] < reality < high[1]
    assert low[2] < dpds < high[2]


@pytest.mark.parametrize(
    ("wins", "fits"),
    [
        ([[0, 1], [1, 0]], True),
        ([[0, 1], [0, 0]], False),
        ([[0, 0], [0, 0]], False),
        ([[0, 1, 0], [0, 0, 1], [1, 0, 0]], True),
        ([[0, 2, 1], [3, 0, 1], [0, 0, 0]], False),
        ([[0, 2, 1], [3, 0, 1], [0, 1, 0]], True),
    ],
)
def test_a_scale_needs_a_way_from_each_to_each(wins, fits):
    assert has_scale(wins) is fits
