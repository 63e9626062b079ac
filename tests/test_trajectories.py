from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from oracles_adaptation import dense_follow
from oracles_trajectories import dense_difference, dense_error, dense_trajectory

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels, Utterance, pool
from mmmgpu.trajectories import (
    difference_band,
    error_and_gradient,
    factor_system,
    lay_out_utterances,
    scaled_smoothness,
    synthesize_trajectory,
)


def random_models(rng, labels="abcd", n_dims=3):
    return PhonemeModels(
        tuple(labels),
        rng.normal(size=(len(labels), n_dims)),
        rng.uniform(0.1, 3, size=(len(labels), n_dims)),
        rng.integers(1, 9, size=len(labels)),
    )


def full_models(rng, labels="abcd", n_dims=3):
    root = rng.normal(size=(len(labels), n_dims, n_dims))
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(n_dims)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return replace(random_models(rng, labels, n_dims), variance=variance, covariance=covariance)


def by_label(models):
    """Means and full covariances as the dense oracles want them."""
    covariance = models.covariance
    if covariance is None:
        covariance = [np.diag(own) for own in models.variance]
    return (
        dict(zip(models.labels, models.mean, strict=True)),
        dict(zip(models.labels, covariance, strict=True)),
    )


def runs(labels):
    return np.cumsum([0, *(a != b for a, b in pairwise(labels))])


def dense_synthesis(models, labels, segments, smoothness, order):
    return np.stack(
        [
            dense_trajectory(
                labels,
                segments,
                dict(zip(models.labels, models.mean[:, j], strict=True)),
                dict(zip(models.labels, models.variance[:, j], strict=True)),
                smoothness[j],
                order,
            )
            for j in range(models.mean.shape[1])
        ],
        axis=1,
    )


@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize(
    "labels", ["a", "ab", "aaaa", "aabb", "aabbc", "abbcccddddab", "aaabbbdd" * 5]
)
def test_trajectory_solves_equation_3(labels, order):
    models = random_models(np.random.default_rng(0))
    smoothness = np.array([0.0, 1.0, 50.0])
    y = synthesize_trajectory(models, list(labels), smoothness=smoothness, order=order)
    want = dense_synthesis(models, labels, runs(labels), smoothness, order)
    np.testing.assert_allclose(y, want, rtol=1e-8, atol=1e-10)


def test_neighbouring_segments_of_one_phone_stay_apart():
    models = random_models(np.random.default_rng(1))
    labels, segments = "aaaabbcc", [0, 0, 0, 1, 2, 2, 3, 3]
    y = synthesize_trajectory(models, list(labels), smoothness=2.0, segments=segments)
    want = dense_synthesis(models, labels, segments, [2.0] * 3, 4)
    np.testing.assert_allclose(y, want, rtol=1e-9)
    assert abs(y - synthesize_trajectory(models, list(labels), smoothness=2.0)).max() > 1e-3


def test_no_frames_give_no_trajectory():
    models = random_models(np.random.default_rng(2))
    assert synthesize_trajectory(models, [], smoothness=1.0).shape == (0, 3)


@pytest.mark.parametrize(("n_frames", "order"), [(0, 4), (1, 1), (4, 4), (5, 4), (9, 3), (30, 4)])
def test_difference_band_is_that_of_the_dense_matrix(n_frames, order):
    w = dense_difference(n_frames, order)
    dense = w.T @ w if n_frames > order else np.zeros((n_frames, n_frames))
    want = [
        [dense[t + i, t] if t + i < n_frames else 0 for i in range(order + 1)]
        for t in range(n_frames)
    ]
    np.testing.assert_allclose(
        difference_band(n_frames, order), np.reshape(want, (n_frames, order + 1)), atol=1e-12
    )


def test_scaled_smoothness_makes_trajectories_follow_the_scale():
    rng = np.random.default_rng(3)
    models = random_models(rng)
    scale = np.array([1e-3, 1.0, 1e4])
    scaled = PhonemeModels(
        models.labels, models.mean * scale, models.variance * scale**2, models.count
    )
    labels = list("aabbbccdda")
    y = synthesize_trajectory(models, labels, smoothness=scaled_smoothness(models, 3.0))
    y_scaled = synthesize_trajectory(scaled, labels, smoothness=scaled_smoothness(scaled, 3.0))
    np.testing.assert_allclose(y_scaled, y * scale, rtol=1e-9)


def make_corpus(rng):
    texts = ["aabbbccd", "ddb", "a", "cccaaabbbddd" * 2]
    return [Utterance(rng.normal(size=(len(text), 1)), list(text)) for text in texts]


def test_gradient_is_the_slope_of_the_dense_error():
    rng = np.random.default_rng(4)
    clips = make_corpus(rng)
    models = pool(clips)
    mean, variance = models.mean[:, 0], models.variance[:, 0]
    z = np.concatenate([u.z[:, 0] for u in clips])
    line = lay_out_utterances(models, clips)
    error, by_mean, by_log_variance = error_and_gradient(line, z, mean, variance, 1.5)

    def dense(mean, variance):
        clips_1d = [(u.z[:, 0], u.labels, runs(u.labels)) for u in clips]
        named = [dict(zip(models.labels, values, strict=True)) for values in (mean, variance)]
        return dense_error(clips_1d, *named, 1.5, 4)

    np.testing.assert_allclose(error, dense(mean, variance), rtol=1e-10)
    for p in range(len(mean)):
        e = 1e-5 * np.eye(len(mean))[p]
        slope = (dense(mean + e, variance) - dense(mean - e, variance)) / 2e-5
        np.testing.assert_allclose(by_mean[p], slope, rtol=1e-6, atol=1e-7)
        up, down = variance * np.exp(e), variance * np.exp(-e)
        slope = (dense(mean, up) - dense(mean, down)) / 2e-5
        np.testing.assert_allclose(by_log_variance[p], slope, rtol=1e-6, atol=1e-7)


def test_a_system_without_a_solution_is_an_error():
    models = random_models(np.random.default_rng(2))
    line = lay_out_utterances(models, [Utterance(np.zeros((8, 3)), list("aabbccdd"))], order=2)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite at frame 0"):
        error_and_gradient(line, np.zeros(8), models.mean[:, 0], -models.variance[:, 0], 1e-9)


def test_utterances_of_one_timeline_do_not_touch():
    clips = make_corpus(np.random.default_rng(5))
    models = pool(clips)
    args = models.mean[:, 0], models.variance[:, 0], 1.5

    def part(utterances):
        z = np.concatenate([u.z[:, 0] for u in utterances])
        return error_and_gradient(lay_out_utterances(models, utterances), z, *args)

    for joint, *parts in zip(part(clips), *(part([u]) for u in clips), strict=True):
        np.testing.assert_allclose(joint, sum(parts), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"smoothness": -1.0}, "smoothness: must be one number >= 0"),
        ({"smoothness": [1.0, 2.0]}, "one for each of 3 dimensions"),
        ({"smoothness": np.nan}, "smoothness: must be"),
        ({"smoothness": 1.0, "order": 0}, "order: must be at least 1"),
    ],
)
def test_bad_arguments_are_named(options, message):
    models = random_models(np.random.default_rng(6))
    with pytest.raises(InputError, match=message):
        synthesize_trajectory(models, list("aab"), **options)


KINDS = pytest.mark.parametrize("make_models", [random_models, full_models])


@KINDS
@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize("labels", ["a", "ab", "aaaa", "aabbc", "abbcccddddab", "aaabbbdd" * 5])
def test_all_dimensions_together_solve_equation_3(labels, order, make_models):
    models = make_models(np.random.default_rng(7))
    smoothness = np.array([0.0, 1.0, 50.0])
    y = synthesize_trajectory(models, list(labels), smoothness=smoothness, order=order)
    want = dense_follow(labels, runs(labels), *by_label(models), smoothness, order)
    np.testing.assert_allclose(y, want, rtol=1e-9, atol=1e-11)


def test_full_covariances_couple_dimensions_and_diagonal_ones_do_not():
    rng = np.random.default_rng(8)
    full = full_models(rng)
    labels = list("aabbbccd")
    apart = [np.diag(own) for own in full.variance]
    diagonal = replace(full, covariance=None)
    y = synthesize_trajectory(diagonal, labels, smoothness=2.0)
    same = synthesize_trajectory(replace(full, covariance=np.array(apart)), labels, smoothness=2.0)
    np.testing.assert_allclose(same, y, rtol=1e-10)
    assert abs(synthesize_trajectory(full, labels, smoothness=2.0) - y).max() > 1e-2


@KINDS
def test_slope_of_the_system_is_that_of_the_dense_error(make_models):
    rng = np.random.default_rng(9)
    models = make_models(rng)
    texts = ["aabbbccd", "ddb", "a", "cccaaabbb"]
    clips = [Utterance(rng.normal(size=(len(text), 3)), list(text)) for text in texts]
    z = np.concatenate([u.z for u in clips])
    smoothness = np.array([0.5, 1.0, 3.0])
    system = factor_system(lay_out_utterances(models, clips), models, smoothness)
    error, slope = system.error_and_slope(models.mean, z)

    def dense(mean):
        gaussians = by_label(replace(models, mean=mean))
        return sum(
            np.sum((u.z - dense_follow(u.labels, runs(u.labels), *gaussians, smoothness, 4)) ** 2)
            for u in clips
        )

    np.testing.assert_allclose(error, dense(models.mean), rtol=1e-10)
    for p, j in np.ndindex(models.mean.shape):
        e = np.zeros_like(models.mean)
        e[p, j] = 1e-4
        central = (dense(models.mean + e) - dense(models.mean - e)) / 2e-4
        np.testing.assert_allclose(slope[p, j], central, rtol=1e-5, atol=1e-8)


@KINDS
def test_slope_of_many_means_is_that_of_each(make_models):
    """Of phones that are not there, too: c and d."""
    rng = np.random.default_rng(10)
    models = make_models(rng)
    clips = [Utterance(rng.normal(size=(len(text), 3)), list(text)) for text in ("aabbba", "bb")]
    z = np.concatenate([u.z for u in clips])
    system = factor_system(lay_out_utterances(models, clips), models, np.array([0.5, 1.0, 3.0]))
    slope_of = system.slope_of(z)
    for mean in (models.mean, rng.normal(size=models.mean.shape)):
        want = system.error_and_slope(mean, z)[1]
        np.testing.assert_allclose(slope_of(mean), want, rtol=1e-11, atol=1e-12)
        assert not want[2:].any()
        assert want[:2].all()
