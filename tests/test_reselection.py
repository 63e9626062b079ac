from dataclasses import replace

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels, Utterance, pool
from mmmgpu.reselection import carry
from mmmgpu.trajectories import scaled_smoothness, synthesize_trajectory


def pooled(rng, n_dims=3):
    labels = list("aabbbccccdd" * 4)
    means = rng.normal(size=(4, n_dims))
    z = means[["abcd".index(p) for p in labels]] + 0.3 * rng.normal(size=(len(labels), n_dims))
    return pool([Utterance(z, labels)], floor_share=1e-6), z


def test_means_and_covariances_go_through_the_matrix():
    rng = np.random.default_rng(0)
    models, _ = pooled(rng)
    M = rng.normal(size=(4, 3))
    diagonal = carry(models, M)
    full = carry(models, M, covariance="full")
    want = [M @ np.diag(own) @ M.T for own in models.variance]
    # the variance of frames drawn from the models: each phone's own, and that of the means
    frames = np.repeat(np.arange(4), models.count)
    spread = np.mean([np.diag(want[p]) for p in frames], axis=0)
    floor = 0.05 * (spread + np.var([M @ models.mean[p] for p in frames], axis=0))
    for p in range(4):
        np.testing.assert_allclose(diagonal.mean[p], M @ models.mean[p], rtol=1e-12)
        kept = np.maximum(np.diag(want[p]), floor)
        np.testing.assert_allclose(diagonal.variance[p], kept, rtol=1e-12)
        np.testing.assert_allclose(full.covariance[p], want[p] + np.diag(floor), rtol=1e-9)
        np.testing.assert_allclose(full.variance[p], np.diag(full.covariance[p]), rtol=1e-12)
    np.testing.assert_array_equal(full.mean, diagonal.mean)
    assert diagonal.labels == full.labels == models.labels
    assert diagonal.covariance is None


def test_the_floor_is_a_share_of_the_streams_variance():
    rng = np.random.default_rng(1)
    models, z = pooled(rng)
    M = np.diag([1.0, 5.0, 0.2])
    carried = carry(replace(models, variance=1e-9 * models.variance), M, floor_share=0.5)
    between = np.repeat(models.mean, models.count, axis=0).var(axis=0) * np.diag(M) ** 2
    np.testing.assert_allclose(carried.variance, np.tile(0.5 * between, (4, 1)), rtol=1e-6)
    assert (np.diag(M) ** 2 * z.var(axis=0) > between).all()


def test_the_identity_changes_nothing_above_the_floor():
    models, _ = pooled(np.random.default_rng(2))
    same = carry(models, np.eye(3), floor_share=1e-12)
    np.testing.assert_allclose(same.mean, models.mean, rtol=1e-14)
    np.testing.assert_allclose(same.variance, models.variance, rtol=1e-14)


def test_full_models_can_be_carried_on_and_back():
    rng = np.random.default_rng(3)
    models, _ = pooled(rng)
    M = rng.normal(size=(3, 3))
    there = carry(models, M, covariance="full", floor_share=1e-12)
    back = carry(there, np.linalg.inv(M), covariance="full", floor_share=1e-12)
    want = [np.diag(own) for own in models.variance]
    np.testing.assert_allclose(back.covariance, want, atol=1e-9)


def test_trajectories_follow_full_models_through_the_matrix():
    """A matrix with a fourth dimension that is a sum: Sigma' is singular but for the floor."""
    rng = np.random.default_rng(4)
    models, _ = pooled(rng)
    M = np.vstack([np.eye(3), np.ones(3)])
    labels = list("aaabbcccddab")
    y = synthesize_trajectory(models, labels, smoothness=0.0)
    carried = carry(models, M, covariance="full", floor_share=1e-6)
    moved = synthesize_trajectory(carried, labels, smoothness=0.0)
    np.testing.assert_allclose(moved, y @ M.T, atol=1e-9)
    smooth = synthesize_trajectory(carried, labels, smoothness=scaled_smoothness(carried, 1.0))
    np.testing.assert_allclose(smooth[:, 3], smooth[:, :3].sum(axis=1), atol=0.05)


def test_a_prototype_that_nothing_uses_keeps_a_variance_above_zero():
    models, _ = pooled(np.random.default_rng(5))
    M = np.vstack([np.eye(3), np.zeros(3)])
    for covariance in ("diagonal", "full"):
        carried = carry(models, M, covariance=covariance)
        assert (carried.variance > 0).all()
        y = synthesize_trajectory(carried, list("aabbcc"), smoothness=1.0)
        np.testing.assert_array_equal(y[:, 3], 0)


@pytest.mark.parametrize(
    ("matrix", "options", "message"),
    [
        (np.eye(2), {}, r"one column for each of 3 old dimensions, got shape \(2, 2\)"),
        (np.full((3, 3), np.nan), {}, "matrix: must be finite"),
        (np.ones(3), {}, r"got shape \(3,\)"),
        (np.eye(3), {"covariance": "banded"}, "must be one of diagonal, full, got 'banded'"),
    ],
)
def test_bad_input_is_named(matrix, options, message):
    models = PhonemeModels(("a",), np.zeros((1, 3)), np.ones((1, 3)), np.array([1]))
    with pytest.raises(InputError, match=message):
        carry(models, matrix, **options)
