import numpy as np
import pytest
from oracles_dynamics import (
    dpds_design,
    dpds_least_squares,
    dpds_path,
    dpds_slope,
    drawn_labels,
)

from mmmgpu import dpds_equations
from mmmgpu.dpds_equations import best_offsets, normal_equations, profile, trajectories
from mmmgpu.labelled import batches, check_labelled


def drawn(rng, *, first=None, frames=40, d=3):
    """Data, batches of it, and any A."""
    labels = [*drawn_labels(rng, 7, labels="abcd", first=first), [first or "a"]]
    data = check_labelled([rng.normal(size=(len(own), d)) for own in labels], labels)
    return data, batches(data, frames=frames), rng.uniform(-0.95, 0.95, (len(data.labels), d))


@pytest.fixture(params=[4_000_000, 300], ids=["one stretch", "short stretches"])
def any_stretch(request, monkeypatch):
    monkeypatch.setattr(dpds_equations, "BLOCK_NUMBERS", request.param)


@pytest.mark.usefixtures("any_stretch")
def test_the_sums_are_those_of_the_dense_system():
    data, parts, A = drawn(np.random.default_rng(0))
    D, b = normal_equations(A, parts)
    for j in range(3):
        X = np.concatenate([dpds_design(A[:, j], rows) for rows in data.rows])
        np.testing.assert_allclose(D[j], X.T @ X, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(b[j], X.T @ data.frames[:, j], rtol=1e-10, atol=1e-10)


@pytest.mark.usefixtures("any_stretch")
@pytest.mark.parametrize("first", [None, "SIL"])
def test_mu_and_nu_are_those_of_dense_least_squares(first):
    data, parts, A = drawn(np.random.default_rng(1), first=first)
    best, P = best_offsets(A, parts), len(data.labels)
    for j in range(3):
        y = [one[:, j] for one in data.y]
        want = dpds_least_squares(A[:, j], data.rows, y)  # zero where nothing depends on it
        np.testing.assert_allclose(best.mu[:, j], want[:P], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(best.nu[:, j], want[P:], rtol=1e-8, atol=1e-10)
    if first:
        assert data.labels[0] == first
        assert best.mu[0].all()
        assert not best.mu[1:].any()  # nothing starts there


def test_the_paths_are_those_of_the_recursion():
    data, parts, A = drawn(np.random.default_rng(2))
    best = best_offsets(A, parts)
    for batch in parts:
        x = trajectories(best, batch)
        for i, s in enumerate(batch.order):
            for j in range(3):
                want = dpds_path(A[:, j], best.mu[:, j], best.nu[:, j], data.rows[s])
                np.testing.assert_allclose(x[i, : len(want), j], want, rtol=1e-12, atol=1e-14)


def test_the_slope_is_that_of_appendix_a():
    data, parts, A = drawn(np.random.default_rng(3))
    error, slope, best = profile(A, parts)
    for j in range(3):
        own = (A[:, j], best.mu[:, j], best.nu[:, j])
        pairs = list(zip(data.rows, data.y, strict=True))
        want = sum(dpds_slope(*own, rows, y[:, j]) for rows, y in pairs)
        np.testing.assert_allclose(slope[:, j], want, rtol=1e-9, atol=1e-9)
        squares = sum(np.sum((dpds_path(*own, rows) - y[:, j]) ** 2) for rows, y in pairs)
        np.testing.assert_allclose(error[j], squares, rtol=1e-12)


def test_the_slope_is_that_of_central_differences():
    _, parts, A = drawn(np.random.default_rng(4))
    slope, h = profile(A, parts)[1], 1e-5
    measured = np.empty_like(A)
    for p in range(len(A)):
        step = np.zeros_like(A)
        step[p] = h  # dimensions are apart: all at once
        measured[p] = (profile(A + step, parts)[0] - profile(A - step, parts)[0]) / (2 * h)
    np.testing.assert_allclose(slope, measured, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
