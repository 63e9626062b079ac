import numpy as np
import pytest
from oracles_dynamics import dense_posterior, drawn_labels

from mmmgpu.kalman import smooth
from mmmgpu.labelled import batches, check_labelled
from mmmgpu.slds import Slds


def drawn_slds(rng, *, d=3, full=False, labels="abc"):
    """Any parameters, stable, for each label and one row more."""
    n = len(labels) + 1

    def covariance(scale):
        if not full:
            return scale * rng.uniform(0.3, 2, (n, d))
        root = rng.normal(size=(n, d, d))
        return scale * (root @ root.swapaxes(1, 2) + 0.3 * np.eye(d))

    A = rng.uniform(-0.9, 0.9, (n, d))
    if full:
        A = 0.8 * np.linalg.qr(rng.normal(size=(n, d, d)))[0]
    mu, nu = rng.normal(size=(2, n, d))
    return Slds(tuple(labels), mu, covariance(1), A, nu, covariance(0.5), covariance(0.7))


def dense(model):
    """The parameters as full matrices, for the oracle."""
    d = model.mu.shape[1]
    return {
        name: value if name in ("mu", "nu") or value.ndim == 3 else value[:, :, None] * np.eye(d)
        for name, value in vars(model).items()
        if name != "labels"
    }


@pytest.mark.parametrize("full", [False, True])
def test_likelihood_and_smoothed_states_are_those_of_the_dense_joint_gaussian(full):
    rng = np.random.default_rng(0)
    model = drawn_slds(rng, full=full)
    labels = [*drawn_labels(rng, 4, length=(6, 11)), ["b"]]
    data = check_labelled([rng.normal(size=(len(own), 3)) for own in labels], labels)
    for batch in batches(data, frames=20):
        found = smooth(model.system, batch)
        for i, s in enumerate(batch.order):
            T = len(data.y[s])
            value, mean, covariance = dense_posterior(dense(model), data.rows[s], data.y[s])
            covariance = covariance.reshape(T, 3, T, 3)
            np.testing.assert_allclose(found.log_likelihood[i], value, rtol=1e-8)
            np.testing.assert_allclose(found.mean[i, :T].reshape(T, 3), mean, rtol=1e-8)
            for t in range(T):
                now, before = covariance[t, :, t], covariance[t, :, t - 1]
                got, cross = found.covariance[i, t], found.cross[i, t]
                if full:
                    np.testing.assert_allclose(got[0], now, rtol=1e-8, atol=1e-12)
                    np.testing.assert_allclose(cross[0], before * (t > 0), rtol=1e-7, atol=1e-12)
                else:
                    np.testing.assert_allclose(got[:, 0, 0], np.diag(now), rtol=1e-8)
                    want = np.diag(before) * (t > 0)
                    np.testing.assert_allclose(cross[:, 0, 0], want, rtol=1e-7, atol=1e-12)
