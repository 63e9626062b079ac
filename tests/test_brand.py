import numpy as np
import pytest
from oracles_dynamics import dense_brand, drawn_labels

from mmmgpu.brand import Brand
from mmmgpu.dynamics import trajectory


def fitted(rng, number=5):
    labels = drawn_labels(rng, number)
    return Brand.fit([rng.normal(size=(len(own), 3)).cumsum(axis=0) for own in labels], labels)


@pytest.mark.parametrize("labels", ["abacab", "ab", "a", "ccccccccc"])
def test_the_trajectory_is_that_of_a_dense_solve(labels):
    model = fitted(np.random.default_rng(0))
    rows = ["abc".index(label) for label in labels]
    parts = (model.mean, model.variance, model.step_mean, model.step_variance)
    want = np.stack([dense_brand(*(p[rows, j] for p in parts)) for j in range(3)], axis=1)
    np.testing.assert_allclose(trajectory(model, labels), want, rtol=1e-10, atol=1e-12)


def test_no_label_no_frame():
    assert list(fitted(np.random.default_rng(0)).generate("")) == []


def test_the_gaussians_are_those_of_the_frames_and_of_their_steps():
    rng = np.random.default_rng(1)
    labels = [list("aabb" * 20), list("baab" * 20)]
    y = [rng.normal(size=(80, 2)) for _ in labels]
    model = Brand.fit(y, labels)
    entered = [(s, t) for s in (0, 1) for t in range(1, 80) if labels[s][t] == "b"]
    steps = np.array([y[s][t] - y[s][t - 1] for s, t in entered])
    np.testing.assert_allclose(model.step_mean[1], steps.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(model.step_variance[1], steps.var(axis=0), rtol=1e-12)
    frames = np.concatenate(y)[np.array(labels).ravel() == "b"]
    np.testing.assert_allclose(model.mean[1], frames.mean(axis=0), rtol=1e-12)


def test_a_label_that_is_never_entered_has_the_steps_of_all():
    y = np.random.default_rng(2).normal(size=(6, 2))
    model = Brand.fit([y, y[:1]], [list("abbccc"), ["a"]])
    np.testing.assert_array_equal(model.step_mean[0], model.step_mean[-1])
    np.testing.assert_allclose(model.step_mean[0], np.diff(y, axis=0).mean(axis=0), rtol=1e-12)
    alone = Brand.fit([y[:1], y[1:2]], ["a", "b"])
    np.testing.assert_array_equal(alone.step_mean, np.zeros((3, 2)))
