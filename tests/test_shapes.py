import numpy as np
import oracles_aam as oracles
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.shapes import align, fit_pose, inverse_pose, place, procrustes_mean, size_of


def some_shapes(count, *, points=7, noise=1.0, seed=0):
    """Noisy copies (T, N, 2) of one shape, each somewhere, of some size, turned by up to 0.5."""
    rng = np.random.default_rng(seed)
    shape = rng.normal(0, 20, (points, 2))
    turn, size = rng.uniform(-0.5, 0.5, count), rng.uniform(0.7, 1.4, count)
    pose = np.stack([size * np.cos(turn), size * np.sin(turn), *rng.normal(0, 50, (2, count))], -1)
    return place(pose, shape + rng.normal(0, noise, (count, points, 2))), shape, pose


def weights(points=7, *, seed=0):
    return np.random.default_rng(seed).uniform(0.2, 3, points)


@pytest.mark.parametrize("points", [2, 3, 40])
def test_a_pose_is_that_of_dense_least_squares(points):
    shapes, shape, _ = some_shapes(5, points=points)
    w = weights(points)
    poses = fit_pose(np.broadcast_to(shape, shapes.shape), shapes, w)
    for pose, target in zip(poses, shapes, strict=True):
        assert_allclose(pose, oracles.similarity(shape, target, w), rtol=1e-9, atol=1e-9)


def test_an_exact_pose_is_found_again():
    shapes, shape, pose = some_shapes(4, noise=0)
    assert_allclose(
        fit_pose(np.broadcast_to(shape, shapes.shape), shapes, weights()), pose, rtol=1e-9
    )


def test_points_are_carried_as_complex_numbers_are():
    _, shape, pose = some_shapes(3)
    for p in pose:
        assert_allclose(place(p, shape), oracles.carry(p, shape), rtol=1e-12)


def test_an_inverse_pose_undoes_its_pose():
    shapes, _, pose = some_shapes(6)
    assert_allclose(place(inverse_pose(pose), place(pose, shapes)), shapes, rtol=1e-9, atol=1e-9)
    assert_allclose(size_of(inverse_pose(pose)), 1 / size_of(pose), rtol=1e-12)


def test_no_similarity_brings_the_mean_nearer_to_an_aligned_shape():
    shapes, shape, _ = some_shapes(3, noise=5)
    aligned, poses = align(shapes, shape, weights())
    assert_allclose(place(poses, aligned), shapes, rtol=1e-9, atol=1e-9)
    best = (((aligned - shape) ** 2).sum(axis=2) * weights()).sum(axis=1)
    rng = np.random.default_rng(1)
    for _ in range(20):
        other = place(np.array([1.0, 0, 0, 0]) + rng.normal(0, 0.01, 4), shape)
        again = (((other - aligned) ** 2).sum(axis=2) * weights()).sum(axis=1)
        assert (again > best).all()


def test_sums_of_the_mean_and_of_differences_from_it_are_aligned():
    shapes, shape, _ = some_shapes(3, noise=5)
    aligned, _ = align(shapes, shape, weights())
    made = shape + np.tensordot([0.3, -1.2, 2.0], aligned - shape, axes=1)
    again, (pose,) = align(made[None], shape, weights())
    assert_allclose(again[0], made, atol=1e-9)
    assert_allclose(pose, [1, 0, 0, 0], atol=1e-9)


def test_the_mean_of_one_shape_in_many_places_is_that_shape():
    shapes, shape, _ = some_shapes(8, noise=0)
    mean = procrustes_mean(shapes, weights())
    aligned, _ = align(mean[None], shape, weights())
    assert_allclose(aligned[0], shape, atol=1e-9)


def test_the_mean_is_the_mean_of_what_is_aligned_to_it():
    shapes, _, _ = some_shapes(9, noise=3)
    mean = procrustes_mean(shapes, weights())
    again = align(shapes, mean, weights())[0].mean(axis=0)
    assert_allclose(again / np.linalg.norm(again), mean / np.linalg.norm(mean), atol=1e-7)


def test_the_mean_has_the_mean_size_about_the_origin_and_stands_as_the_first_shape():
    shapes, _, _ = some_shapes(9, noise=3)
    mean = procrustes_mean(shapes, weights())
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    assert_allclose(np.linalg.norm(mean), np.linalg.norm(centred, axis=(1, 2)).mean(), rtol=1e-9)
    assert_allclose(mean.mean(axis=0), 0, atol=1e-9)
    assert_allclose(fit_pose(mean, centred[0], weights())[1], 0, atol=1e-6)


def test_inputs_stay_as_they_were():
    shapes, shape, _ = some_shapes(3)
    kept = shapes.copy(), shape.copy()
    procrustes_mean(shapes, weights())
    align(shapes, shape, weights())
    assert_array_equal(shapes, kept[0])
    assert_array_equal(shape, kept[1])
