import numpy as np
from oracles_kernels import sample
from tiny_pair import tiny_pair

from mmmgpu.picture_errors import flow_weights, texture_weights


def test_an_error_of_alpha_is_worth_its_flow_under_the_lips():
    basis = tiny_pair().source
    e = np.random.default_rng(0).normal(size=len(basis.moving))
    flow = basis.flow(e).astype(float)
    square = sum(basis.w_f[y, x] * (flow[y, x] ** 2).sum() for y, x in np.ndindex(basis.w_f.shape))
    W = flow_weights(basis)
    np.testing.assert_allclose(e @ W @ e, square / basis.w_f.sum(), rtol=1e-5)


def test_an_error_of_beta_is_worth_the_change_of_the_picture_in_the_references_shape():
    basis = tiny_pair().source
    e = np.random.default_rng(1).normal(size=len(basis.images))
    e -= e.mean()
    y, x = np.indices(basis.w_t.shape)
    places = (np.stack([x, y], axis=-1) + basis.flows).reshape(len(basis.images), -1, 2)
    carried = [sample(*given) for given in zip(basis.images.astype(float), places, strict=True)]
    change = sum(e_i * own for e_i, own in zip(e, carried, strict=True))
    square = (basis.w_t.reshape(-1, 1) * change**2).sum() / 3 / basis.w_t.sum()
    W = texture_weights(basis)
    np.testing.assert_allclose(e @ W @ e, square, rtol=1e-5)
    np.testing.assert_allclose(W @ np.ones(len(W)), 0, atol=1e-6)
