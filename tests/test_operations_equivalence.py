"""Reference against slow loops, and every backend against the reference, on hostile inputs."""

import numpy as np
import oracles_kernels as oracles
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu import operations

SIZES = [(1, 1), (1, 7), (9, 1), (5, 3), (33, 64), (65, 31)]
LARGE = (576, 720)


def grid(height, width):
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([x, y], axis=-1)


def tearing(rng, height, width):
    flow = np.zeros((height, width, 2), np.float32)
    flow[..., 0] = np.where(grid(height, width)[..., 0] < width / 2, -2.3, 2.6)
    return flow


FLOWS = {
    "zero": lambda rng, h, w: np.zeros((h, w, 2), np.float32),
    "constant": lambda rng, h, w: np.full((h, w, 2), [1.25, -0.7], np.float32),
    "random": lambda rng, h, w: rng.normal(0, 3, (h, w, 2)).astype(np.float32),
    "converging": lambda rng, h, w: (np.float32([w, h]) / 2.1 - grid(h, w)).astype(np.float32),
    "tearing": tearing,
    "leaving": lambda rng, h, w: np.full((h, w, 2), [w - 0.5, 0.5 - h], np.float32),
    "tiny": lambda rng, h, w: rng.choice(np.float32([1e-30, -1e-30, 1e-9, -1e-9]), (h, w, 2)),
    "1e6": lambda rng, h, w: rng.choice(np.float32([1e6, -1e6, 0.5]), (h, w, 2)),
    "1e30": lambda rng, h, w: rng.choice(np.float32([1e30, -1e30, 0.5]), (h, w, 2)),
}


def assert_close(actual, desired):
    """Within 1e-5 of the desired output's scale."""
    assert actual.dtype == np.float32
    scale = np.abs(desired).max(initial=1e-30)
    assert_allclose(actual, desired, rtol=0, atol=1e-5 * scale)


def field_and_flow(flow, size, channels, batch=2):
    rng = np.random.default_rng(channels)
    field = rng.normal(0, 1, (batch, *size, channels)).astype(np.float32)
    return field, np.stack([FLOWS[flow](rng, *size) for _ in range(batch)])


def weights_with_holes(rng, size):
    """Weights of four images: no holes, half holes, one valid pixel in the corner, holes left."""
    weight = rng.uniform(0.5, 1, (4, *size)).astype(np.float32)
    weight[1] *= rng.random(size) < 0.5
    weight[2] = 0
    weight[3, :, : size[1] // 2] = 0
    weight[1:, -1, -1] = 1
    return weight


@pytest.mark.parametrize("size", SIZES[:4])
@pytest.mark.parametrize("flow", FLOWS)
def test_the_reference_warps_as_the_loops_do(flow, size):
    field, flows = field_and_flow(flow, size, 2)
    warped, weight = operations.forward_warp(field, flows, backend="numpy")
    for b in range(2):
        desired, desired_weight = oracles.forward_warp(field[b], flows[b])
        assert_close(weight[b], desired_weight)
        assert_close(warped[b], desired)


@pytest.mark.parametrize("size", [*SIZES[:4], (13, 10)])
def test_the_reference_fills_as_the_loops_do(size):
    rng = np.random.default_rng(0)
    field = rng.normal(0, 1, (4, *size, 2)).astype(np.float32)
    weight = weights_with_holes(rng, size)
    filled = operations.fill_holes(field, weight, threshold=0.25, backend="numpy")
    for b in range(4):
        assert_close(filled[b], oracles.fill_holes(field[b], weight[b], 0.25))


def test_the_reference_blends_samples_and_scans_as_the_loops_do():
    rng = np.random.default_rng(0)
    field = rng.normal(0, 1, (3, 5, 4, 2)).astype(np.float32)
    weights = rng.normal(0, 1, 3)
    points = rng.uniform(-2, 7, (6, 2)).astype(np.float32)
    assert_close(operations.blend(field, weights, backend="numpy"), oracles.blend(field, weights))
    assert_close(
        operations.sample(field[0], points, backend="numpy"), oracles.sample(field[0], points)
    )
    queries, corpus, shares = field[:2].reshape(2, 20, 2), field.reshape(3, 20, 2), rng.random(20)
    assert_close(
        operations.distance_scan(queries, corpus, shares, backend="numpy"),
        oracles.distance_scan(queries, corpus, shares),
    )


def test_the_reference_multiplies_as_the_loops_do():
    rng = np.random.default_rng(0)
    images, wanted = rng.normal(0, 1, (3, 5, 4, 2)), rng.normal(0, 1, (5, 4, 2))
    gram, right = operations.normal_equations(images, wanted, backend="numpy")
    desired, column = oracles.normal_equations(images, wanted)
    assert_close(gram, desired)
    assert_close(right, column[:, 0])


def mesh(rng, points, pixels):
    """Triangles, and pixels in them: also at corners, and outside by a little."""
    triangles = rng.integers(0, points, (7, 3))
    barycentric = rng.dirichlet(np.ones(3), pixels).astype(np.float32)
    barycentric[: pixels // 3] = np.eye(3)[rng.integers(0, 3, pixels // 3)]
    barycentric[-1] = (1.2, -0.1, -0.1)
    return triangles, rng.integers(0, 7, pixels), barycentric


def test_the_reference_warps_meshes_as_the_loops_do():
    rng = np.random.default_rng(0)
    field = rng.normal(0, 1, (2, 5, 4, 3)).astype(np.float32)
    vertices = rng.uniform(-2, 7, (2, 6, 2)).astype(np.float32)
    given = mesh(rng, 6, 20)
    warped = operations.piecewise_warp(field, vertices, *given, backend="numpy")
    for b in range(2):
        assert_close(warped[b], oracles.piecewise_warp(field[b], vertices[b], *given))


@pytest.mark.parametrize("sharpness", [0, 0.03, 5])
def test_the_reference_evaluates_gaussians_as_the_loops_do(sharpness):
    rng = np.random.default_rng(0)
    given = [rng.normal(0, 3, s).astype(np.float32) for s in ((9, 2), (4, 2), (4, 2), (2, 3))]
    actual = operations.evaluate_rbf(*given, sharpness, backend="numpy")
    assert_close(actual, oracles.evaluate_rbf(*given, sharpness))


@pytest.mark.parametrize("channels", range(1, 9))
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("flow", FLOWS)
def test_forward_warp(backend, flow, size, channels):
    field, flows = field_and_flow(flow, size, channels)
    actual = operations.forward_warp(field, flows, backend=backend)
    desired = operations.forward_warp(field, flows, backend="numpy")
    for a, d in zip(actual, desired, strict=True):
        assert_close(a, d)


@pytest.mark.parametrize("flow", ["random", "converging"])
def test_forward_warp_of_a_large_picture(backend, flow):
    field, flows = field_and_flow(flow, LARGE, 3, batch=1)
    actual = operations.forward_warp(field, flows, backend=backend)
    desired = operations.forward_warp(field, flows, backend="numpy")
    for a, d in zip(actual, desired, strict=True):
        assert_close(a, d)


@pytest.mark.parametrize(("fields", "flows"), [(1, 5), (5, 1), (5, 5)])
def test_a_single_field_or_flow_serves_the_whole_batch(backend, fields, flows):
    field, flow = field_and_flow("random", (8, 9), 3, batch=5)
    every = np.broadcast_to(field[:fields], field.shape), np.broadcast_to(flow[:flows], flow.shape)
    actual = operations.forward_warp(field[:fields], flow[:flows], backend=backend)
    desired = operations.forward_warp(*every, backend="numpy")
    for a, d in zip(actual, desired, strict=True):
        assert_close(a, d)


@pytest.mark.parametrize("channels", range(1, 9))
@pytest.mark.parametrize("size", SIZES)
def test_fill_holes(backend, size, channels):
    rng = np.random.default_rng(channels)
    field = rng.normal(0, 1, (4, *size, channels)).astype(np.float32)
    weight = weights_with_holes(rng, size)
    actual = operations.fill_holes(field, weight, threshold=0.25, backend=backend)
    assert_close(actual, operations.fill_holes(field, weight, threshold=0.25, backend="numpy"))
    assert_array_equal(actual[weight >= 0.25], field[weight >= 0.25])


def test_fill_holes_of_a_large_picture(backend):
    rng = np.random.default_rng(0)
    field = rng.random((4, *LARGE, 3), dtype=np.float32)
    weight = weights_with_holes(rng, LARGE)
    actual = operations.fill_holes(field, weight, threshold=0.25, backend=backend)
    assert_close(actual, operations.fill_holes(field, weight, threshold=0.25, backend="numpy"))


@pytest.mark.parametrize("number", [1, 46])
@pytest.mark.parametrize("size", [*SIZES, (96, 80)])
def test_blend(backend, size, number):
    rng = np.random.default_rng(number)
    images = rng.normal(0, 1, (number, *size, 3)).astype(np.float32)
    weights = rng.normal(0, 1, (2, number)) * (rng.random((2, number)) < 0.5)
    actual = operations.blend(images, weights, backend=backend)
    assert_close(actual, operations.blend(images, weights, backend="numpy"))


@pytest.mark.parametrize("results", [2, 3, 4, 5, 9])
def test_results_that_are_blended_together_are_the_bits_of_each_alone(backend, results):
    rng = np.random.default_rng(results)
    images = rng.normal(0, 1, (13, 7, 11, 3)).astype(np.float32)
    weights = rng.normal(0, 1, (results, 13))
    together = operations.blend(images, weights, backend=backend)
    alone = [operations.blend(images, w, backend=backend) for w in weights]
    assert_array_equal(together, np.reshape(alone, together.shape))


def test_blend_of_many_images_whose_sum_grows_large_and_cancels(backend):
    rng = np.random.default_rng(0)
    images = rng.uniform(1, 2, (20_000, 5, 9, 3)).astype(np.float32)
    half = rng.uniform(0.1, 0.2, 10_000)
    weights = np.concatenate([half, -half[::-1]])
    actual = operations.blend(images, weights, backend=backend)
    assert_close(actual, operations.blend(images, weights, backend="numpy"))


def assert_same_equations(images, wanted, backend):
    actual = operations.normal_equations(images, wanted, backend=backend)
    desired = operations.normal_equations(images, wanted, backend="numpy")
    for a, d in zip(actual, desired, strict=True):
        assert_close(a, d)


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 8, 46])
@pytest.mark.parametrize("size", [*SIZES, (96, 80)])
def test_normal_equations(backend, size, number):
    rng = np.random.default_rng(number)
    images, wanted = rng.normal(0, 1, (number, *size, 3)), rng.normal(0, 1, (*size, 3))
    assert_same_equations(images, wanted, backend)


def test_normal_equations_of_large_equal_pictures(backend):
    """Adding one number many times is where a float32 sum drifts most."""
    assert_same_equations(np.full((2, *LARGE, 3), 0.3), np.full((*LARGE, 3), 0.7), backend)


def test_equal_images_have_equal_products(backend):
    """To the bit, wherever they stand, as do those of an image and an equal one that is wanted."""
    images = np.random.default_rng(0).random((11, 13, 7, 3))
    images[8] = images[2]
    gram, right = operations.normal_equations(images, images[5], backend=backend)
    assert_array_equal(gram, gram.T)
    assert_array_equal(gram[8], gram[2])
    assert_array_equal(right, gram[5])


@pytest.mark.parametrize("channels", range(1, 9))
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("flow", FLOWS)
def test_sample(backend, flow, size, channels):
    field, flows = field_and_flow(flow, size, channels)
    points = grid(*size) + flows
    actual = operations.sample(field, points, backend=backend)
    assert_close(actual, operations.sample(field, points, backend="numpy"))


@pytest.mark.parametrize("channels", range(1, 9))
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("far", [0, 3, 1e6, 1e38])
def test_piecewise_warp(backend, far, size, channels):
    rng = np.random.default_rng(channels)
    field = rng.normal(0, 1, (3, *size, channels))
    vertices = rng.uniform(0, size[::-1], (3, 9, 2)) + far * rng.normal(0, 1, (3, 9, 2)).clip(-1, 1)
    given = field, vertices, *mesh(rng, 9, 50)
    actual = operations.piecewise_warp(*given, backend=backend)
    assert_close(actual, operations.piecewise_warp(*given, backend="numpy"))


@pytest.mark.parametrize(("fields", "sets"), [(1, 4), (4, 1)])
def test_piecewise_warp_of_a_large_picture(backend, fields, sets):
    rng = np.random.default_rng(0)
    field = rng.random((fields, *LARGE, 3), dtype=np.float32)
    vertices = rng.uniform(0, LARGE[::-1], (sets, 40, 2))
    given = field, vertices, *mesh(rng, 40, 5000)
    actual = operations.piecewise_warp(*given, backend=backend)
    assert_close(actual, operations.piecewise_warp(*given, backend="numpy"))


@pytest.mark.parametrize("channels", range(1, 9))
@pytest.mark.parametrize(("queries", "rows"), [(1, 1), (2, 3), (5, 70)])
@pytest.mark.parametrize("points", [1, 16, 17, 1000])
def test_distance_scan(backend, points, queries, rows, channels):
    rng = np.random.default_rng(points)
    q = rng.normal(0, 1, (queries, points, channels))
    c = rng.normal(0, 1, (rows, points, channels))
    w = rng.random(points)
    actual = operations.distance_scan(q, c, w, backend=backend)
    assert_close(actual, operations.distance_scan(q, c, w, backend="numpy"))


def test_distances_do_not_depend_on_where_the_fields_stand(backend):
    """Equal fields are equally far, to the bit: which comes first may decide between them."""
    query, row = np.random.default_rng(0).random((2, 1, 100, 2))
    several = np.repeat(query, 5, axis=0), np.repeat(row, 71, axis=0)
    distance = operations.distance_scan(*several, np.ones(100), backend=backend)
    assert_array_equal(distance, np.full((5, 71), distance[0, 0]))


def test_distance_scan_of_large_equal_residuals(backend):
    """Adding one number many times is where a float32 sum drifts most."""
    queries, corpus = np.full((1, 720 * 576, 2), 0.3), np.zeros((2, 720 * 576, 2))
    weights = np.full(720 * 576, 0.7)
    actual = operations.distance_scan(queries, corpus, weights, backend=backend)
    assert_close(actual, operations.distance_scan(queries, corpus, weights, backend="numpy"))


@pytest.mark.parametrize("number", [1, 3, 38])
@pytest.mark.parametrize("sharpness", [0, 1e-30, 1e-3, 0.05, 20, 1e30])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("flow", FLOWS)
def test_evaluate_rbf(backend, flow, size, sharpness, number):
    rng = np.random.default_rng(number)
    points = grid(*size) + FLOWS[flow](rng, *size)
    centres = rng.uniform(-3, max(size), (number, 2))
    weights, affine = rng.normal(0, 10, (number, 2)), rng.normal(0, 1, (2, 3))
    given = points, centres, weights, affine, sharpness
    actual = operations.evaluate_rbf(*given, backend=backend)
    assert_close(actual, operations.evaluate_rbf(*given, backend="numpy"))


def test_evaluate_rbf_of_many_centres_that_add_up(backend):
    """Adding one number many times is where a float32 sum drifts most."""
    given = np.zeros((1, 2)), np.zeros((100_000, 2)), np.full((100_000, 2), 0.7), np.zeros((2, 3))
    actual = operations.evaluate_rbf(*given, 1, backend=backend)
    assert_close(actual, operations.evaluate_rbf(*given, 1, backend="numpy"))


def test_evaluate_rbf_where_squares_exceed_float32(backend):
    """The Gaussian of sharpness 0 is 1 at any distance."""
    given = [[3e38, -3e38]], [[-3e38, 3e38]], [[5, 7]], np.zeros((2, 3)), 0
    assert_array_equal(operations.evaluate_rbf(*given, backend=backend), [[5, 7]])
