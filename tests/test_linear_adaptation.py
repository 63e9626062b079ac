import numpy as np
import pytest
from oracles_adaptation import mllr_row

from mmmgpu.linear_adaptation import map_means, regress_means
from mmmgpu.phonemes import PhonemeModels

GROUPS = np.array([0, 0, 1, 0, 2])
FRAMES = np.array([0, 0, 1, 1, 1, 2, 2, 0])  # 3 has no frame; 4 is a class without frames


def example(seed=0, n_dims=3):
    rng = np.random.default_rng(seed)
    models = PhonemeModels(
        tuple("abcde"),
        rng.normal(size=(5, n_dims)),
        rng.uniform(0.2, 3, size=(5, n_dims)),
        rng.integers(1, 9, size=5),
    )
    return models, rng.normal(size=(len(FRAMES), n_dims))


def free_entries(shape, j, n_dims):
    return {"shift": [0], "diagonal": [0, j + 1], "full": list(range(n_dims + 1))}[shape]


@pytest.mark.parametrize("d", [2, 3])  # of three phones, no more than a row has entries, and fewer
@pytest.mark.parametrize("ridge", [0.1, 3.0, 1000.0])
@pytest.mark.parametrize("shape", ["shift", "diagonal", "full"])
def test_regression_is_the_least_squares_of_numpy(shape, ridge, d):
    models, z = example(n_dims=d)
    adapted = regress_means(models, FRAMES, z, GROUPS, shape=shape, ridge=ridge)
    xi = np.hstack([np.ones((5, 1)), models.mean])
    scale = np.r_[1, np.sqrt(models.typical_variance)]
    for g in (0, 1):
        frames = np.flatnonzero(GROUPS[FRAMES] == g)
        for j in range(d):
            row = mllr_row(
                z[frames, j],
                xi[FRAMES[frames]],
                models.variance[FRAMES[frames], j],
                np.eye(d, d + 1, 1)[j],
                free_entries(shape, j, d),
                ridge,
                scale,
            )
            own = np.flatnonzero(np.equal(GROUPS, g))
            np.testing.assert_allclose(adapted[own, j], xi[own] @ row, rtol=1e-9, atol=1e-10)
    np.testing.assert_array_equal(adapted[4], models.mean[4])


def test_a_shift_without_a_ridge_is_the_weighted_mean_of_what_is_off():
    models, z = example(1)
    adapted = regress_means(models, FRAMES, z, GROUPS, shape="shift", ridge=0.0)
    frames = FRAMES != 2
    weight = 1 / models.variance[FRAMES[frames]]
    off = z[frames] - models.mean[FRAMES[frames]]
    bias = (weight * off).sum(axis=0) / weight.sum(axis=0)
    np.testing.assert_allclose(adapted[[0, 1, 3]], models.mean[[0, 1, 3]] + bias, rtol=1e-12)


@pytest.mark.parametrize("shape", ["shift", "diagonal", "full"])
def test_a_phone_without_frames_moves_with_its_class(shape):
    models, z = example(2)
    adapted = regress_means(models, FRAMES, z, GROUPS, shape=shape, ridge=1.0)
    assert abs(adapted[3] - models.mean[3]).min() > 1e-3


def test_known_scale_and_bias_are_found():
    models, _ = example(3)
    phone = np.tile(np.arange(5), 3)
    truth = models.mean * [0.5, 2.0, 1.0] + [1.0, 0.0, -3.0]
    one_class = np.zeros(5, int)
    for shape in ("diagonal", "full"):
        found = regress_means(models, phone, truth[phone], one_class, shape=shape, ridge=1e-9)
        np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-6)
    shifted = regress_means(models, phone, truth[phone], one_class, shape="shift", ridge=0.0)
    assert abs(shifted - truth).max() > 0.1


def test_a_heavy_ridge_keeps_the_means():
    models, z = example(4)
    for shape in ("shift", "diagonal", "full"):
        kept = regress_means(models, FRAMES, z, GROUPS, shape=shape, ridge=1e12)
        np.testing.assert_allclose(kept, models.mean, atol=1e-9)


def test_map_weighs_the_frames_of_each_phone_against_tau():
    models, z = example(5)
    adapted = map_means(models, FRAMES, z, tau=4.0)
    for p in range(5):
        own = z[np.equal(FRAMES, p)]
        want = (4 * models.mean[p] + sum(own)) / (4 + len(own))
        np.testing.assert_allclose(adapted[p], want, rtol=1e-12)
    np.testing.assert_array_equal(adapted[[3, 4]], models.mean[[3, 4]])
