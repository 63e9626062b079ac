from dataclasses import replace

import numpy as np
import pytest
from oracles_dynamics import dense_posterior, dense_slds, drawn_labels
from test_kalman import dense, drawn_slds

from mmmgpu.dynamics import trajectory
from mmmgpu.errors import InputError, UnsettledWarning
from mmmgpu.labelled import LARGEST_A, check_labelled
from mmmgpu.slds import Slds, at_least, climb

DIAGONAL_OR_FULL = pytest.mark.parametrize("full", [False, True])


@DIAGONAL_OR_FULL
def test_likelihood_and_smoothed_means_of_a_sequence_are_the_dense_ones(full):
    rng = np.random.default_rng(0)
    model = drawn_slds(rng, full=full)
    labels, y = list("cabbac"), rng.normal(size=(6, 3))
    rows = ["abc".index(label) for label in labels]
    value, mean, covariance = dense_posterior(dense(model), rows, y)
    np.testing.assert_allclose(model.log_likelihood(y, labels), value, rtol=1e-8)
    got, spread = model.smoothed(y, labels)
    np.testing.assert_allclose(got, mean, rtol=1e-8)
    own = covariance.reshape(6, 3, 6, 3)[range(6), :, range(6)]
    want = own if full else own[:, range(3), range(3)]
    np.testing.assert_allclose(spread, want, rtol=1e-8, atol=1e-12)


@DIAGONAL_OR_FULL
def test_em_never_lowers_the_likelihood(full):
    rng = np.random.default_rng(1)
    true = drawn_slds(rng, full=full)
    labels = drawn_labels(rng, 12)
    y = [true.sample(own, rng) for own in labels]
    y[0] *= 30  # a sequence like no other
    y[1][:] = np.arange(len(y[1]))[:, None] ** 2  # and one that A > 1 would suit
    with pytest.warns(UnsettledWarning, match="slds: still gaining after 40 iterations"):
        model, history = climb(check_labelled(y, labels), full=full, iterations=40, tolerance=0)
    steps = np.diff(history)
    assert len(history) == 41
    assert (steps >= -1e-9 * np.abs(history[1:])).all()
    assert history[-1] > history[0] + 100
    values = model.A if not full else np.linalg.eigvals(model.A)
    assert np.abs(values).max() <= LARGEST_A + 1e-12
    total = sum(model.log_likelihood(one, own) for one, own in zip(y, labels, strict=True))
    np.testing.assert_allclose(total, history[-1], rtol=1e-10)


@DIAGONAL_OR_FULL
def test_what_was_drawn_is_fitted_back(full):
    rng = np.random.default_rng(2)
    true = drawn_slds(rng, d=2, full=full, labels="ab")
    true = replace(true, A=np.abs(true.A) if not full else true.A)
    labels = drawn_labels(rng, 250, labels="ab", length=(20, 24))
    data = check_labelled([true.sample(own, rng) for own in labels], labels)
    model, history = climb(data, full=full, iterations=80, tolerance=1e-6)
    truth = sum(true.log_likelihood(y, own) for y, own in zip(data.y, labels, strict=True))
    parameters = sum(np.size(getattr(true, n)[:2]) for n in ("mu", "Sigma", "A", "nu", "Q", "R"))
    assert truth < history[-1] < truth + 2 * parameters  # 2 log ratio is about chi2(parameters)
    np.testing.assert_allclose(model.A[:2], true.A[:2], atol=0.1)
    np.testing.assert_allclose(model.mu[:2], true.mu[:2], atol=0.3)
    np.testing.assert_allclose(model.nu[:2], true.nu[:2], atol=0.15)
    for name in ("Sigma", "Q", "R"):
        got, want = getattr(model, name)[:2], getattr(true, name)[:2]
        np.testing.assert_allclose(got, want, atol=0.25 * np.abs(want).max())


@DIAGONAL_OR_FULL
def test_a_sample_has_the_moments_of_the_dense_gaussian(full):
    rng = np.random.default_rng(3)
    model = drawn_slds(rng, d=2, full=full)
    drawn = np.array([model.sample(list("abc"), rng).ravel() for _ in range(2500)])
    mean, _, covariance = dense_slds(dense(model), [0, 1, 2])
    spread = np.sqrt(np.diag(covariance).max())
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.08 * spread)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.12 * spread**2)


@DIAGONAL_OR_FULL
def test_what_is_generated_is_the_most_likely_sequence(full):
    rng = np.random.default_rng(4)
    model = drawn_slds(rng, full=full)
    labels = list("abbca")
    best = trajectory(model, labels)
    value = model.log_likelihood(best, labels)
    for _ in range(20):
        assert model.log_likelihood(best + 0.01 * rng.normal(size=best.shape), labels) < value


def test_labels_that_start_nothing_or_are_never_entered_are_borrowed_for():
    rng = np.random.default_rng(5)
    labels = [list("abbabb"), list("abab"), ["c"]]
    y = [rng.normal(size=(len(own), 2)) for own in labels]
    model = Slds.fit(y, labels)
    b = np.concatenate([y[0][[1, 2, 4, 5]], y[1][[1, 3]]])
    np.testing.assert_allclose(model.mu[1], b.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(model.mu[-1], np.concatenate(y).mean(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(model.A[2], model.A[-1])
    np.testing.assert_array_equal(model.Q[2], model.Q[-1])
    np.testing.assert_allclose(model.nu[2], (1 - model.A[2]) * model.mu[2], rtol=1e-12)


def test_the_covariance_nearest_in_likelihood_is_not_below_the_least():
    rng = np.random.default_rng(6)
    root = rng.normal(size=(3, 1))
    singular, least = root @ root.T, np.diag([0.1, 0.2, 0.3])
    got = at_least(singular[None, None], least[None, None])[0, 0]
    np.testing.assert_allclose(np.linalg.eigvalsh(got - least).min(), 0, atol=1e-12)

    def value(c):  # log likelihood of a sample with covariance `singular`
        return -np.linalg.slogdet(c)[1] - np.trace(np.linalg.solve(c, singular))

    for _ in range(50):
        push = rng.normal(size=(3, 3)) * 0.05
        other = got + push @ push.T
        assert value(other) < value(got)
    kept = at_least(least[None, None] * 2, least[None, None])[0, 0]
    np.testing.assert_allclose(kept, least * 2, rtol=1e-14)


def test_no_label_cannot_be_sampled():
    model = drawn_slds(np.random.default_rng(7))
    with pytest.raises(InputError, match="labels: none given"):
        model.sample([], np.random.default_rng(0))
    assert list(model.generate([])) == []
