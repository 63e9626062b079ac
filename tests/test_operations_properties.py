"""What must hold for any input, on every backend."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu import operations

each_run_alike = settings(max_examples=40, deadline=None, derandomize=True)
sizes = st.tuples(st.integers(1, 9), st.integers(1, 9))


def numbers(limit):
    return st.floats(-limit, limit, width=32)


def flows(size, limit=20):
    return arrays(np.float32, (*size, 2), elements=numbers(limit))


@each_run_alike
@given(st.data(), sizes, numbers(1000))
def test_a_constant_field_stays_constant_where_anything_arrives(backend, data, size, value):
    flow = data.draw(flows(size))
    field = np.full((*size, 1), value, np.float32)
    warped, weight = operations.forward_warp(field, flow, backend=backend)
    assert_allclose(warped[weight > 0], value, rtol=1e-6)
    assert_array_equal(warped[weight == 0], 0)


@each_run_alike
@given(sizes, st.integers(-5, 5), st.integers(-5, 5))
def test_a_translation_by_whole_pixels_is_exact(backend, size, dx, dy):
    height, width = size
    field = np.random.default_rng(0).normal(0, 1, (*size, 2)).astype(np.float32)
    flow = np.full((*size, 2), [dx, dy], np.float32)
    warped, weight = operations.forward_warp(field, flow, backend=backend)
    moved, arrived = np.zeros_like(field), np.zeros(size)
    for y in range(max(dy, 0), min(height + dy, height)):
        for x in range(max(dx, 0), min(width + dx, width)):
            moved[y, x], arrived[y, x] = field[y - dy, x - dx], 1
    assert_array_equal(warped, moved)
    assert_array_equal(weight, arrived)


@each_run_alike
@given(st.data(), sizes)
def test_the_weight_is_that_of_the_taps_inside(backend, data, size):
    flow = data.draw(flows(size))
    _, weight = operations.forward_warp(np.ones((*size, 1)), flow, backend=backend)
    y, x = np.mgrid[: size[0], : size[1]]
    whole = np.floor(flow)
    fraction = (flow - whole).astype(float)
    inside = 0.0
    for dy, wy in enumerate((1 - fraction[..., 1], fraction[..., 1])):
        for dx, wx in enumerate((1 - fraction[..., 0], fraction[..., 0])):
            tx, ty = x + whole[..., 0] + dx, y + whole[..., 1] + dy
            inside += (wx * wy)[(tx >= 0) & (tx < size[1]) & (ty >= 0) & (ty < size[0])].sum()
    assert_allclose(weight.sum(dtype=float), inside, rtol=1e-5, atol=1e-6)


@each_run_alike
@given(st.data(), sizes, numbers(100))
def test_holes_in_a_constant_field_get_the_constant(backend, data, size, value):
    valid = data.draw(arrays(bool, size))
    valid.flat[data.draw(st.integers(0, valid.size - 1))] = True
    field = np.where(valid[..., None], np.float32(value), np.float32(7))
    filled = operations.fill_holes(field, valid, threshold=0.5, backend=backend)
    assert_allclose(filled, np.float32(value), rtol=1e-6)


@each_run_alike
@given(st.data(), st.integers(1, 6), numbers(10), numbers(10))
def test_blend_is_linear(backend, data, number, a, b):
    images = np.random.default_rng(number).normal(0, 1, (number, 3, 7, 3))
    one, two = (data.draw(arrays(np.float32, number, elements=numbers(10))) for _ in "ab")
    together = operations.blend(images, a * one + b * two, backend=backend)
    apart = operations.blend(images, np.stack([one, two]), backend=backend)
    terms = a * apart[0].astype(float), b * apart[1].astype(float)
    scale = np.abs(images).sum() * (np.abs(a * one) + np.abs(b * two)).max()
    assert_allclose(together, sum(terms), rtol=0, atol=1e-6 * scale + 1e-30)


@each_run_alike
@given(st.data(), st.integers(1, 40), st.integers(1, 3))
def test_distance_is_symmetric_and_obeys_the_triangle_inequality(backend, data, points, channels):
    fields = data.draw(arrays(np.float32, (3, points, channels), elements=numbers(100)))
    weights = np.random.default_rng(points).random(points)
    d = operations.distance_scan(fields, fields, weights, backend=backend)
    slack = 1e-5 * d.max() + 1e-30
    assert_array_equal(np.diag(d), 0)
    assert_allclose(d, d.T, rtol=0, atol=slack)
    assert d[0, 2] <= d[0, 1] + d[1, 2] + slack


@each_run_alike
@given(sizes)
def test_sampling_at_the_pixels_returns_the_field(backend, size):
    field = np.random.default_rng(0).normal(0, 1, (*size, 3)).astype(np.float32)
    y, x = np.mgrid[: size[0], : size[1]]
    assert_array_equal(operations.sample(field, np.stack([x, y], -1), backend=backend), field)


@each_run_alike
@given(st.data(), st.integers(1, 40), st.integers(-9, 9), st.integers(-9, 9))
def test_gaussians_move_with_their_centres(backend, data, number, dx, dy):
    points = data.draw(arrays(np.float32, (number, 2), elements=st.integers(-99, 99)))
    rng = np.random.default_rng(number)
    centres, weights, still = rng.integers(0, 9, (5, 2)), rng.normal(0, 5, (5, 2)), np.zeros((2, 3))
    rest, by = (weights, still, 0.1), np.array([dx, dy])
    moved = operations.evaluate_rbf(points + by, centres + by, *rest, backend=backend)
    assert_array_equal(moved, operations.evaluate_rbf(points, centres, *rest, backend=backend))


@each_run_alike
@given(st.integers(1, 20))
def test_a_single_gaussian_adds_its_weight_at_its_centre_only(backend, number):
    centres = 10 * np.random.default_rng(number).permutation(number * 2).reshape(number, 2)
    weights = np.random.default_rng(0).normal(0, 5, (number, 2))
    identity = [[0, 1, 0], [0, 0, 1]]
    mapped = operations.evaluate_rbf(centres, centres, weights, identity, 1, backend=backend)
    assert_allclose(mapped, centres + weights, rtol=1e-6)
