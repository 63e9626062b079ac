import numpy as np
from scipy.stats import norm

from mmmgpu.dynamics import trajectory
from mmmgpu.hmm_mean import HmmMean

TRUE = HmmMean(
    ("a", "b"),
    np.array([[1.0, -2.0], [3.0, 0.0], [2.0, -1.0]]),
    np.array([[1.0, 0.5], [2.0, 1.0], [1.5, 2.0]]),
)


def test_what_was_drawn_is_fitted_back():
    rng = np.random.default_rng(0)
    labels = [list("aaab") * 500, list("abbb") * 500]
    model = HmmMean.fit([TRUE.sample(own, rng) for own in labels], labels)
    assert model.labels == TRUE.labels
    np.testing.assert_allclose(model.mean[:2], TRUE.mean[:2], atol=0.1)
    np.testing.assert_allclose(model.variance[:2], TRUE.variance[:2], rtol=0.09)


def test_every_frame_is_its_labels_mean_and_no_part_of_the_model():
    frames = trajectory(TRUE, ["b", "a", "no phone"])
    np.testing.assert_array_equal(frames, TRUE.mean[[1, 0, 2]])
    next(TRUE.generate("b"))[:] = 9
    assert TRUE.mean[1, 0] == 3


def test_the_likelihood_is_that_of_each_frame_apart():
    y = np.random.default_rng(1).normal(size=(3, 2))
    rows = [0, 1, 1]
    want = norm(TRUE.mean[rows], np.sqrt(TRUE.variance[rows])).logpdf(y).sum()
    np.testing.assert_allclose(TRUE.log_likelihood(y, "abb"), want, rtol=1e-12)
