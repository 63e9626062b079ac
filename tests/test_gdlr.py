from itertools import pairwise

import numpy as np
import pytest
from oracles_adaptation import dense_follow, regression_slope
from scipy.linalg import block_diag

from mmmgpu.errors import InputError
from mmmgpu.gdlr import (
    RULES,
    SHAPES,
    Descent,
    curvature_roots,
    descend_means,
    error_and_slope,
    gain,
    identity_regressions,
    regressed,
    standard_units,
)
from mmmgpu.phonemes import PhonemeModels, Utterance
from mmmgpu.trajectories import factor_system, lay_out_utterances

CLASS_OF = np.array([0, 1, 0, 1])  # of the phones a, b, c, d
SMOOTHNESS = np.array([0.5, 3.0])
DENSE = ["diagonal", "full"]


def random_models(rng, kind="diagonal", n_dims=2):
    variance = rng.uniform(0.2, 2, size=(4, n_dims))
    covariance = None
    if kind == "full":
        root = rng.normal(size=(4, n_dims, n_dims))
        covariance = root @ root.transpose(0, 2, 1) + 0.2 * np.eye(n_dims)
        variance = np.diagonal(covariance, axis1=1, axis2=2)
    mean = rng.normal(size=(4, n_dims))
    return PhonemeModels(tuple("abcd"), mean, variance, np.ones(4, int), covariance)


def corpus(rng, texts=("aabbcccd", "dda"), n_dims=2):
    return [Utterance(rng.normal(size=(len(text), n_dims)), list(text)) for text in texts]


def system_of(models, clips, smoothness=SMOOTHNESS):
    system = factor_system(lay_out_utterances(models, clips), models, smoothness)
    return system, np.concatenate([u.z for u in clips])


def dense_arguments(models, clips):
    covariance = models.covariance
    if covariance is None:
        covariance = [np.diag(own) for own in models.variance]
    runs = [np.cumsum([0, *(a != b for a, b in pairwise(u.labels))]) for u in clips]
    return (
        [(u.z, u.labels, own) for u, own in zip(clips, runs, strict=True)],
        dict(zip(models.labels, models.mean, strict=True)),
        dict(zip(models.labels, covariance, strict=True)),
    )


def descend(
    system, mean, z, rule="bounded", *, shape="full", rate=1.0, iterations=30, class_of=CLASS_OF
):
    """Of the first metric of that shape."""
    metric = next(
        own
        for constants, own in RULES[rule].metrics(system, mean, class_of)
        if constants.get("shape", shape) == shape
    )
    return descend_means(system, mean, z, class_of, metric=rate * metric, iterations=iterations)


def roots_of(system, mean, class_of=CLASS_OF, *, shape="full"):
    return curvature_roots(system.line.phone, mean, class_of, shape=shape)


def random_regressions(rng):
    return identity_regressions(2, 2) + 0.3 * rng.normal(size=(2, 2, 3))


@pytest.mark.parametrize("kind", DENSE)
def test_the_adjoint_is_equation_16(kind):
    rng = np.random.default_rng(0)
    models, clips, R = random_models(rng, kind), corpus(rng), random_regressions(rng)
    system, z = system_of(models, clips)
    _, slope = error_and_slope(system, R, models.mean, z, CLASS_OF)
    dense, mean, covariance = dense_arguments(models, clips)
    class_of = dict(zip(models.labels, CLASS_OF, strict=True))
    want = regression_slope(dense, R, mean, covariance, class_of, SMOOTHNESS, 4)
    np.testing.assert_allclose(slope, want, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("kind", DENSE)
def test_the_slope_is_that_of_central_differences(kind):
    rng = np.random.default_rng(1)
    models, clips, R = random_models(rng, kind), corpus(rng), random_regressions(rng)
    system, z = system_of(models, clips)
    error, slope = error_and_slope(system, R, models.mean, z, CLASS_OF)
    dense, mean, covariance = dense_arguments(models, clips)

    def dense_error(R):
        moved = {
            label: R[g] @ np.r_[1, mean[label]]
            for label, g in zip(models.labels, CLASS_OF, strict=True)
        }
        return sum(
            np.sum((own - dense_follow(*text, moved, covariance, SMOOTHNESS, 4)) ** 2)
            for own, *text in dense
        )

    np.testing.assert_allclose(error, dense_error(R), rtol=1e-10)
    for entry in np.ndindex(R.shape):
        e = np.zeros_like(R)
        e[entry] = 1e-4
        central = (dense_error(R + e) - dense_error(R - e)) / 2e-4
        np.testing.assert_allclose(slope[entry], central, rtol=1e-5, atol=1e-8)


def test_it_starts_from_the_means_as_they_are():
    rng = np.random.default_rng(2)
    mean = rng.normal(size=(4, 2))
    np.testing.assert_array_equal(regressed(identity_regressions(2, 2), mean, CLASS_OF), mean)
    models, clips = random_models(rng), corpus(rng)
    system, z = system_of(models, clips)
    path = descend(system, models.mean, z, iterations=0)
    np.testing.assert_array_equal(path, models.mean[None])


def test_an_iteration_is_equation_17():
    rng = np.random.default_rng(3)
    models, clips = random_models(rng), corpus(rng)
    system, z = system_of(models, clips)
    path = descend(system, models.mean, z, "paper", rate=0.01, iterations=2)
    R = identity_regressions(2, 2)
    for moved in path[1:]:
        R = R - 0.01 * error_and_slope(system, R, models.mean, z, CLASS_OF)[1]
        np.testing.assert_allclose(moved, regressed(R, models.mean, CLASS_OF), rtol=1e-12)
    assert len(path) == 3


def test_roots_are_of_the_curvature_of_free_trajectories():
    """Were y = R_g xi_t, the Hessian of E in a row of R_g would be 2 sum xi xi'."""
    rng = np.random.default_rng(4)
    mean = rng.normal(size=(4, 2))
    phone, class_of = np.array([0, 0, 2, 1, 1, 1]), np.array([0, 1, 0, 2])
    full, diagonal = (
        curvature_roots(phone, mean, class_of, shape=shape, damping=0.3) for shape in SHAPES[::-1]
    )
    for g, rows in ((0, [0, 0, 2]), (1, [1, 1, 1])):
        H = 0.6 * np.eye(3)
        for p in rows:
            H += 2 * np.outer(np.r_[1, mean[p]], np.r_[1, mean[p]])
        for j in (0, 1):
            np.testing.assert_allclose(full[g, j] @ full[g, j] @ H, np.eye(3), atol=1e-12)
            free, held = [0, j + 1], 2 - j
            inverse = (diagonal[g, j] @ diagonal[g, j])[np.ix_(free, free)]
            np.testing.assert_allclose(inverse @ H[np.ix_(free, free)], np.eye(2), atol=1e-12)
            assert not diagonal[g, j, held].any()
            assert not diagonal[g, j, :, held].any()
    assert not full[2].any()
    assert not diagonal[2].any()


def test_the_diagonal_shape_scales_and_shifts_each_dimension():
    rng = np.random.default_rng(12)
    models, clips = random_models(rng), corpus(rng)
    system, z = system_of(models, clips)
    moved = descend(system, models.mean, z, shape="diagonal", class_of=np.zeros(4, int))[-1]
    for before, after in zip(models.mean.T, moved.T, strict=True):
        np.testing.assert_allclose(after, np.polyval(np.polyfit(before, after, 1), before))
        assert np.abs(after - before).max() > 1e-2


def test_metrics_are_by_the_curvature_and_never_longer_than_by_that_bound():
    models, system, _ = amplifying()
    calm = factor_system(system.line, models, np.full(3, 1e-9))  # nothing is smoothed: c = 1
    found = list(RULES["bounded"].metrics(system, models.mean, CLASS_OF))
    assert [constants for constants, _ in found] == [{"shape": shape} for shape in SHAPES]
    for constants, metric in found:
        roots = roots_of(system, models.mean, **constants)
        c = gain(system, models.mean, CLASS_OF, roots)
        assert (c > 2).all()
        np.testing.assert_allclose(metric * c[:, None, None], roots @ roots, rtol=1e-12)
    for constants, metric in RULES["bounded"].metrics(calm, models.mean, CLASS_OF):
        roots = roots_of(system, models.mean, **constants)
        np.testing.assert_allclose(metric, roots @ roots, rtol=1e-6)


def many_clips(rng, n_clips=5, n_dims=6):
    """About what 15 seconds hold: four phones in long and short runs, much silence (a)."""
    clips = []
    for _ in range(n_clips):
        middle = [p for _ in range(12) for p in [str(rng.choice(list("bcd")))] * rng.integers(2, 6)]
        labels = ["a"] * 15 + middle + ["a"] * 15
        z = np.cumsum(rng.normal(size=(len(labels), n_dims)), axis=0) / 5
        clips.append(Utterance(z, labels))
    return clips


def errors(system, path, z):
    return np.array([np.sum((system.follow(mean) - z) ** 2) for mean in path])


@pytest.mark.parametrize("kind", DENSE)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("rate", [*RULES["bounded"].rates, 1.0])
@pytest.mark.parametrize("smoothness", [0.01, 1.0, 100.0])
def test_training_error_falls_with_every_iteration(kind, rate, shape, smoothness):
    rng = np.random.default_rng(5)
    models, clips = random_models(rng, kind, n_dims=6), many_clips(rng)
    system, z = system_of(models, clips, np.full(6, smoothness))
    curve = errors(system, descend(system, models.mean, z, shape=shape, rate=rate), z)
    assert len(curve) == 31
    at_the_end = curve[1:] <= curve[-1] * (1 + 1e-12)  # as far as it goes, but for rounding
    assert ((np.diff(curve) < 0) | at_the_end).all()
    assert curve[-1] < 0.8 * curve[0]


def amplifying():
    """Silence of large variance at both ends: smoothing extrapolates what is next to it."""
    rng = np.random.default_rng(9)
    models = random_models(rng, n_dims=3)
    variance = np.tile([[100.0], [0.01], [0.01], [0.01]], 3)
    models = PhonemeModels(models.labels, models.mean, variance, models.count)
    return models, *system_of(models, many_clips(rng, n_dims=3), np.full(3, 1000.0))


def test_training_error_falls_where_smoothing_amplifies_and_the_plain_bound_does_not_hold():
    models, system, z = amplifying()
    assert (np.diff(errors(system, descend(system, models.mean, z), z)) < 0).all()
    roots = roots_of(system, models.mean)
    path = descend_means(system, models.mean, z, CLASS_OF, metric=roots @ roots)
    assert (np.diff(errors(system, path, z)) > 0).any()


@pytest.mark.parametrize("kind", DENSE)
@pytest.mark.parametrize("shape", SHAPES)
def test_gain_is_the_largest_curvature_in_units_of_that_bound(kind, shape):
    """The Hessian entry by entry: the slope at each unit matrix with nothing to meet."""
    rng = np.random.default_rng(10)
    models, clips = random_models(rng, kind), many_clips(rng, n_clips=2, n_dims=2)
    system, z = system_of(models, clips)
    roots = roots_of(system, models.mean, shape=shape)
    columns = []
    for entry in np.ndindex(2, 2, 3):
        unit = np.zeros((2, 2, 3))
        unit[entry] = 1
        columns.append(error_and_slope(system, unit, models.mean, 0 * z, CLASS_OF)[1].ravel())
    root = block_diag(*roots.reshape(4, 3, 3))
    hessian = root @ np.array(columns).T @ root
    row = np.tile(np.repeat([0, 1], 3), 2)  # dimension of each entry
    if kind == "full":
        want = [np.linalg.eigvalsh(hessian)[-1]]
    else:
        np.testing.assert_allclose(hessian[row == 0][:, row == 1], 0, atol=1e-12)
        want = [np.linalg.eigvalsh(hessian[row == j][:, row == j])[-1] for j in (0, 1)]
    found = gain(system, models.mean, CLASS_OF, roots)
    assert found.shape == (len(want),)
    assert (found <= want * np.array(1 + 1e-12)).all()
    assert (found > 0.75 * np.array(want)).all()


def test_the_scale_of_the_coordinates_does_not_matter_much_to_the_bounded_rule():
    """Where the means are large against 1, R xi is the same in other units."""
    rng = np.random.default_rng(6)
    models, clips = random_models(rng, n_dims=3), many_clips(rng, n_dims=3)
    lam = np.ones(3)

    def final(unit):
        own = PhonemeModels(
            models.labels, models.mean * unit, models.variance * unit**2, models.count
        )
        moved = [Utterance(u.z * unit, u.labels) for u in clips]
        system, z = system_of(own, moved, lam / unit**2)
        return descend(system, own.mean, z)[-1] / unit

    np.testing.assert_allclose(final(1e4), final(1e3), rtol=1e-3)


def test_the_papers_step_goes_down_if_small_and_else_diverges_and_stops_cleanly():
    rng = np.random.default_rng(7)
    models, clips = random_models(rng, n_dims=6), many_clips(rng)
    system, z = system_of(models, clips, np.full(6, 1.0))
    small = errors(system, descend(system, models.mean, z, "paper", rate=1e-4), z)
    assert (np.diff(small) < 0).all()
    path = descend(system, models.mean, z, "paper", rate=0.5, iterations=500)
    large = errors(system, path, z)
    assert (np.diff(large) > 0).all()
    assert 10 < len(path) < 501
    assert np.isfinite(large).all()


def test_a_phone_without_frames_moves_with_its_class_and_a_class_without_frames_stays():
    rng = np.random.default_rng(8)
    models = random_models(rng)
    clips = corpus(rng, texts=("aabbaab",))
    system, z = system_of(models, clips)
    class_of = np.array([0, 1, 0, 2])
    moved = descend(system, models.mean, z, class_of=class_of)[-1]
    assert abs(moved[2] - models.mean[2]).max() > 1e-2
    np.testing.assert_array_equal(moved[3], models.mean[3])


def test_standard_units_are_where_frames_lie_and_how_far_from_their_phones():
    mean, variance = np.array([[0.0, 1.0], [3.0, 1.0]]), np.array([[1.0, 4.0], [4.0, 7.0]])
    models = PhonemeModels(("a", "b"), mean, variance, np.array([2, 1]))
    centre, unit = standard_units(models)
    np.testing.assert_allclose(centre, [1, 1], rtol=1e-12)
    np.testing.assert_allclose(unit**2, (2 * (1 + 4) + 4 + 7) / 6, rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rule": "steepest"}, "must be one of bounded, paper, got 'steepest'"),
        ({"iterations": -1}, "must not be negative, got -1"),
        ({"rates": (0.5, 1.5)}, "rates: must be above 0 and at most 1 with the rule bounded"),
        ({"rates": (0.0,)}, "rates: must be above 0"),
        ({"rule": "paper", "rates": (-1.0,)}, "rates: must be above 0 and at most inf"),
    ],
)
def test_bad_descents_are_named(options, message):
    with pytest.raises(InputError, match=message):
        Descent(**options)
