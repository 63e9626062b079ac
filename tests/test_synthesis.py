from dataclasses import replace

import numpy as np
import oracles_model as oracles
import pytest

from mmmgpu.backends import get_backend
from mmmgpu.synthesis import NO_TEXTURE, synthesize, synthesize_one

ALL = ("numpy", "warp", "opencl")


def coordinates(basis, seed=0, frames=3):
    """Random alphas (T, M - 1) of about unit length and betas (T, M) on the simplex."""
    rng = np.random.default_rng(seed)
    count = len(basis.images)
    alpha = rng.normal(0, 0.4, (frames, count - 1))
    return alpha, rng.dirichlet(np.ones(count), frames)


@pytest.mark.parametrize("seed", [0, 1])
def test_synthesis_is_equation_1_and_2(basis, seed):
    alpha, beta = coordinates(basis, seed)
    made = list(synthesize(basis, alpha, beta, backend="numpy"))
    assert len(made) == 3
    for image, a, b in zip(made, alpha, beta, strict=True):
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, oracles.synthesize(basis, a, b), atol=1e-5)


def test_every_backend_makes_the_same_pictures(basis, backend):
    alpha, beta = coordinates(basis, 2)
    wanted = synthesize(basis, alpha, beta, backend="numpy")
    for image, reference in zip(
        synthesize(basis, alpha, beta, backend=backend), wanted, strict=True
    ):
        np.testing.assert_allclose(image, reference, atol=1e-4)


@pytest.mark.parametrize("name", ALL)
def test_a_prototype_s_own_coordinates_give_it_back(basis, name):
    kernels = get_backend(name)
    count = len(basis.images)
    for k, i in enumerate(basis.moving):
        made = synthesize_one(basis, np.eye(count - 1)[k], np.eye(count)[i], kernels)
        np.testing.assert_allclose(made, basis.images[i], atol=1e-5)
    made = synthesize_one(basis, np.zeros(count - 1), np.eye(count)[basis.reference], kernels)
    np.testing.assert_allclose(made, basis.images[basis.reference], atol=1e-5)


@pytest.mark.parametrize("name", ALL)
def test_prototypes_without_texture_do_not_matter(basis, name):
    kernels = get_backend(name)
    alpha, beta = coordinates(basis)
    beta[:, [1, 3]] = 0
    beta /= beta.sum(axis=1, keepdims=True)
    images = basis.images.copy()
    images[[1, 3]] = 0.123
    other = replace(basis, images=images)
    for a, b in zip(alpha, beta, strict=True):
        np.testing.assert_array_equal(
            synthesize_one(basis, a, b, kernels), synthesize_one(other, a, b, kernels)
        )


def test_prototypes_without_texture_cost_nothing(basis, monkeypatch):
    kernels = get_backend("numpy")
    warp, sizes = type(kernels).forward_warp, []

    def counted(self, field, flow):
        sizes.append(len(field))
        return warp(self, field, flow)

    monkeypatch.setattr(type(kernels), "forward_warp", counted)
    synthesize_one(basis, np.zeros(4), np.array([0.5, 0, 0, 0.5, 0]), kernels)
    assert sizes == [2, 2]


def test_textures_that_cannot_be_seen_cost_no_brightness(basis):
    kernels = get_backend("numpy")
    alpha, _ = coordinates(basis)
    beta = np.full(len(basis.images), 0.99 * NO_TEXTURE)
    beta[0] = 1 - beta[1:].sum()
    only = np.eye(len(basis.images))[0]
    np.testing.assert_array_equal(
        synthesize_one(basis, alpha[0], beta, kernels),
        synthesize_one(basis, alpha[0], only, kernels),
    )


def test_pictures_stay_in_range(basis):
    bright = replace(basis, images=np.ones_like(basis.images))
    alpha, beta = coordinates(basis, 3)
    for image in synthesize(bright, 3 * alpha, beta, backend="numpy"):
        np.testing.assert_allclose(image, 1, atol=1e-5)
        assert image.max() <= 1


def test_synthesis_is_lazy(basis):
    alpha, beta = coordinates(basis, frames=1)
    asked = []

    def endless(row):
        while True:
            asked.append(1)
            yield row

    made = synthesize(basis, endless(alpha[0]), endless(beta[0]), backend="numpy")
    next(made)
    assert len(asked) == 2
