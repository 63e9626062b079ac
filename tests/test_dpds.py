import numpy as np
import pytest
from oracles_dynamics import dpds_least_squares, dpds_path, drawn_labels
from scipy.stats import norm

from mmmgpu import dpds
from mmmgpu.dpds import Dpds, descend
from mmmgpu.dynamics import trajectory
from mmmgpu.errors import UnsettledWarning
from mmmgpu.labelled import LARGEST_A, check_labelled


def drawn_dpds(rng, *, d=2, labels="abc"):
    n = len(labels) + 1
    mu, nu = rng.normal(size=(2, n, d))
    return Dpds(tuple(labels), mu, rng.uniform(0.2, 0.9, (n, d)), nu, rng.uniform(0.2, 0.5, d) ** 2)


def test_what_was_drawn_is_fitted_back():
    rng = np.random.default_rng(0)
    true = drawn_dpds(rng)
    labels = drawn_labels(rng, 150, length=(20, 40))
    model = Dpds.fit([true.sample(own, rng) for own in labels], labels)
    np.testing.assert_allclose(model.A[:3], true.A[:3], atol=0.03)
    np.testing.assert_allclose(model.mu[:3], true.mu[:3], atol=0.15)
    np.testing.assert_allclose(model.nu[:3], true.nu[:3], atol=0.1)
    np.testing.assert_allclose(model.R, true.R, rtol=0.06)


def test_the_likelihood_is_that_of_the_noise_about_the_path():
    rng = np.random.default_rng(1)
    model, rows = drawn_dpds(rng), [2, 0, 0, 1]
    y = rng.normal(size=(4, 2))
    want = sum(
        norm(dpds_path(model.A[:, j], model.mu[:, j], model.nu[:, j], rows), model.R[j] ** 0.5)
        .logpdf(y[:, j])
        .sum()
        for j in range(2)
    )
    np.testing.assert_allclose(model.log_likelihood(y, list("caab")), want, rtol=1e-12)


def test_no_better_parameters_are_near():
    rng = np.random.default_rng(2)
    labels = drawn_labels(rng, 10)
    y = [rng.normal(size=(len(own), 2)).cumsum(axis=0) for own in labels]
    model = Dpds.fit(y, labels)

    def error(m):
        pairs = zip(labels, y, strict=True)
        return sum(np.sum((trajectory(m, own) - one) ** 2) for own, one in pairs)

    least = error(model)
    for name in ("mu", "nu", "A"):
        for sign in (-1, 1):
            other = vars(model) | {name: getattr(model, name) + sign * 1e-3}
            assert name == "A" or error(Dpds(**other)) > least
            other[name] = (
                np.clip(other[name], -LARGEST_A, LARGEST_A) if name == "A" else other[name]
            )
            assert error(Dpds(**other)) > least


def walks(rng, d=3):
    labels = drawn_labels(rng, 8)
    return check_labelled([rng.normal(size=(len(o), d)).cumsum(axis=0) for o in labels], labels)


def test_the_descent_ends_where_a_span_of_iterations_gains_little(monkeypatch):
    monkeypatch.setattr(dpds, "SPAN", 4)
    monkeypatch.setattr(dpds, "TOLERANCE", 0.05)
    _, history = descend(walks(np.random.default_rng(6)))
    spans = history[:-4] - np.array(history[4:])
    assert len(spans) > 4
    assert spans[-1] < 0.05 <= spans[:-1].min()


def test_what_descends_is_minus_log_likelihood():
    data = walks(np.random.default_rng(6))
    model, history = descend(data)
    assert (np.diff(history) <= 0).all()
    said = [[data.labels[p] for p in rows] for rows in data.rows]
    e = [trajectory(model, own) - y for own, y in zip(said, data.y, strict=True)]
    share = (np.concatenate(e) ** 2).mean(axis=0) / data.frames.var(axis=0)
    np.testing.assert_allclose(history[-1], np.log(share).mean() / 2, atol=1e-5)


def test_a_descent_that_is_cut_short_says_so():
    data = walks(np.random.default_rng(5))
    with pytest.warns(UnsettledWarning, match="dpds: still gaining after 4 iterations"):
        model, history = descend(data, iterations=4)
    assert len(history) == 5
    assert np.isfinite(model.A).all()


def test_a_stays_below_one_where_the_data_run_away():
    y = [np.exp(0.3 * np.arange(20.0))[:, None], np.arange(30.0)[:, None] ** 2]
    labels = [["a"] * 20, ["a"] * 10 + ["b"] * 20]
    model = Dpds.fit(y, labels)
    assert np.abs(model.A[:2]).max() == LARGEST_A
    assert np.isfinite(trajectory(model, ["a"] * 100_000)).all()


def test_labels_that_start_nothing_or_are_never_entered_have_their_mean():
    rng = np.random.default_rng(3)
    labels = [list("sabbab"), list("saab"), ["c"]]
    y = [rng.normal(size=(len(own), 2)) for own in labels]
    model = Dpds.fit(y, labels)
    _, b, c, s = range(4)
    of_b = np.concatenate([y[0][[2, 3, 5]], y[1][[3]]])
    np.testing.assert_allclose(model.mu[b], of_b.mean(axis=0), rtol=1e-12)
    rows = [[model.labels.index(label) for label in own] for own in labels]
    for j in range(2):
        wanted = dpds_least_squares(model.A[:-1, j], rows, [one[:, j] for one in y])
        np.testing.assert_allclose(model.mu[s, j], wanted[s], rtol=1e-8)
    np.testing.assert_array_equal(model.A[c], model.A[-1])
    np.testing.assert_allclose(model.nu[c], (1 - model.A[c]) * y[2][0], rtol=1e-12)
    np.testing.assert_allclose(model.mu[-1], np.concatenate(y).mean(axis=0), rtol=1e-12)


def test_noise_is_counted_from_the_second_frame():
    rng = np.random.default_rng(4)
    labels = drawn_labels(rng, 6)
    y = [rng.normal(size=(len(own), 2)) for own in labels]
    model = Dpds.fit(y, labels)
    pairs = list(zip(labels, y, strict=True))
    squares = sum((((trajectory(model, own) - one)[1:]) ** 2).sum(axis=0) for own, one in pairs)
    np.testing.assert_allclose(model.R, squares / sum(len(one) - 1 for one in y), rtol=1e-10)
