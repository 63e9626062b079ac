from itertools import pairwise

import numpy as np
import oracles_model as oracles
import pytest
from worlds import texture

from mmmgpu.flows import (
    MATCHERS,
    NEIGHBOURS,
    ROW,
    at_scale,
    best_flow,
    concatenate,
    explanation_error,
    extend_flows,
    matcher,
    path_to,
    pull,
    read_at,
    shortest_paths,
)


def grid(height, width):
    y, x = np.mgrid[:height, :width].astype(np.float64)
    return np.stack([x, y], axis=-1)


def affine_flow(matrix, shift, height, width):
    """The flow (H, W, 2) that carries p to ``matrix @ p + shift``."""
    points = grid(height, width)
    return (points @ np.asarray(matrix).T + shift - points).astype(np.float32)


@pytest.mark.parametrize("name", MATCHERS)
def test_a_known_motion_is_found(name):
    large = texture(80, 90)
    a, b = large[10:70, 10:80], large[8:68, 13:83]  # b shows the same 3 px further left, 2 lower
    flow = matcher(name)(a, b)
    assert flow.shape == (60, 70, 2)
    assert flow.dtype == np.float32
    inside = flow[10:-10, 10:-10].reshape(-1, 2)
    np.testing.assert_allclose(np.median(inside, axis=0), (-3, 2), atol=0.15)
    assert np.abs(inside - (-3, 2)).mean() < 0.3


@pytest.mark.parametrize("scale", [0.5, 0.68, 1.0])
def test_flow_is_found_in_smaller_pictures(scale):
    large = texture(81, 90)
    a, b = large[10:71, 10:80], large[8:69, 13:83]
    flow = at_scale(matcher(), scale)(a, b)
    assert flow.shape == (61, 70, 2)
    assert flow.dtype == np.float32
    inside = flow[10:-10, 10:-10].reshape(-1, 2)
    np.testing.assert_allclose(np.median(inside, axis=0), (-3, 2), atol=0.2)


def test_pictures_are_not_made_smaller_than_flow_needs():
    seen = []

    def match(a, b):
        seen.append((a.shape, b.shape))
        return np.ones((*a.shape[:2], 2), np.float32)

    flow = at_scale(match, 0.25)(
        np.zeros((40, 84, 3), np.float32), np.zeros((40, 84, 3), np.float32)
    )
    assert seen == [((16, 21, 3), (16, 21, 3))]
    np.testing.assert_allclose(flow, np.broadcast_to([4, 2.5], (40, 84, 2)))


@pytest.mark.parametrize("name", MATCHERS)
def test_matching_leaves_nothing_behind(name):
    a, b, c = (texture(48, 48, seed=seed) for seed in range(3))
    fresh = matcher(name)(a, b)
    used = matcher(name)
    used(c, a)
    np.testing.assert_array_equal(used(a, b), fresh)


@pytest.mark.parametrize("shape", [(1, 1), (2, 7), (9, 5)])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_pull_reads_where_the_flow_points(shape, channels):
    rng = np.random.default_rng(1)
    field = rng.random((*shape, channels)).astype(np.float32)
    flow = rng.uniform(-4, 4, (*shape, 2)).astype(np.float32)
    seen = pull(field, flow)
    padded = np.pad(field, ((0, 1), (0, 1), (0, 0)), mode="edge")  # the oracle needs 2 x 2
    h, w = shape
    for y in range(h):
        for x in range(w):
            px, py = np.clip((x + flow[y, x, 0], y + flow[y, x, 1]), 0, (w - 1, h - 1))
            wanted = oracles.bilinear(padded, px, py)
            np.testing.assert_allclose(seen[y, x], wanted, atol=0.05)  # OpenCV: 1/32 px steps


def test_concatenation_of_affine_flows_is_their_product():
    height, width = 40, 50
    first_matrix, first_shift = [[1.02, 0.05], [-0.04, 0.97]], (1.5, -2.0)
    second_matrix, second_shift = [[0.98, -0.03], [0.06, 1.04]], (-0.7, 1.2)
    first = affine_flow(first_matrix, first_shift, height, width)
    second = affine_flow(second_matrix, second_shift, height, width)
    product = np.asarray(second_matrix) @ first_matrix
    shift = np.asarray(second_matrix) @ first_shift + second_shift
    wanted = affine_flow(product, shift, height, width)
    got = concatenate(first, second)
    inside = np.s_[6:-6, 6:-6]
    np.testing.assert_allclose(got[inside], wanted[inside], atol=0.01)
    swapped = concatenate(second, first)
    assert np.abs(swapped - wanted)[inside].max() > 0.1  # the order matters


def test_explanation_error_is_the_weighted_mean_square():
    rng = np.random.default_rng(2)
    reference, image = rng.random((2, 6, 5, 3)).astype(np.float32)
    mask = rng.random((6, 5)).astype(np.float32)
    still = np.zeros((6, 5, 2), np.float32)
    total = sum(
        mask[y, x] * np.mean((image[y, x] - reference[y, x]) ** 2)
        for y in range(6)
        for x in range(5)
    )
    got = explanation_error(reference, image, still, mask)
    np.testing.assert_allclose(got, total / mask.sum(), rtol=1e-5)


@pytest.mark.parametrize("direct_is_good", [True, False])
def test_best_flow_is_the_one_that_explains_the_image(direct_is_good):
    large = texture(60, 60)
    reference, waypoint, image = large[5:45, 5:45], large[5:45, 6:46], large[5:45, 9:49]
    right, wrong = (np.full((40, 40, 2), (dx, 0), np.float32) for dx in (-4, 3))
    to_waypoint = np.full((40, 40, 2), (-1, 0), np.float32)

    def match(a, b):
        if a is reference:
            return right if direct_is_good else wrong
        return np.full((40, 40, 2), (8, 0) if direct_is_good else (-3, 0), np.float32)

    mask = np.ones((40, 40), np.float32)
    mask[:, :5] = 0  # what has left the picture
    got = best_flow(reference, image, mask, [(waypoint, to_waypoint)], match)
    np.testing.assert_allclose(got, right, atol=1e-5)


def clusters(rng):
    near, far = rng.normal(0, 1, (20, 3)), rng.normal(100, 1, (15, 3))
    return np.concatenate([near, far])


WORLDS = {
    "cloud": lambda rng: rng.normal(size=(40, 4)),
    "chain": lambda rng: np.arange(30.0)[:, None] ** 1.3,
    "clusters": clusters,
    "equal frames": lambda rng: np.repeat(rng.normal(size=(12, 2)), 3, axis=0),
    "one": lambda rng: np.zeros((1, 3)),
    "two": lambda rng: np.array([[0.0], [5.0]]),
}


def walked(path, coordinates):
    return sum(np.linalg.norm(coordinates[a] - coordinates[b]) for a, b in pairwise(path))


@pytest.mark.parametrize("world", WORLDS)
def test_paths_are_as_short_as_floyd_and_warshall_say(world):
    coordinates = WORLDS[world](np.random.default_rng(3))
    n = len(coordinates)
    start = n // 3
    before = shortest_paths(coordinates, start)
    length = oracles.path_lengths(coordinates, NEIGHBOURS)[start]
    assert before[start] == -1
    for target in range(n):
        path = path_to(target, before)
        assert (path[0], path[-1]) == (start, target)
        assert len(set(path)) == len(path)
        if np.isfinite(length[target]):
            np.testing.assert_allclose(walked(path, coordinates), length[target], atol=1e-6)
        else:  # another part of the graph
            assert path == [start, target]


def test_a_long_chain_is_walked_frame_by_frame():
    coordinates = np.arange(100.0)[:, None]
    path = path_to(99, shortest_paths(coordinates, 0))
    assert max(b - a for a, b in pairwise(path)) <= NEIGHBOURS


def test_flows_of_a_tree_are_concatenated_step_by_step():
    pairs = [(3, 7), (7, 8), (7, 9)]
    steps = {(a, b): np.full((4, 5, 2), b - a, np.float32) for a, b in pairs}
    flows = {}
    extend_flows(flows, [3, 7, 8], steps)
    shared = flows[7]
    extend_flows(flows, [3, 7, 9], steps)
    extend_flows(flows, [3], steps)
    assert flows[7] is shared
    assert sorted(flows) == [7, 8, 9]
    for i, flow in flows.items():
        np.testing.assert_array_equal(flow, np.full((4, 5, 2), i - 3))


@pytest.mark.parametrize("count", [1, ROW, 2 * ROW + 3, 40_000])
def test_points_are_read_as_a_flow_reads_them(count):
    rng = np.random.default_rng(2)
    height, width = 9, 7
    field = rng.random((height, width, 3)).astype(np.float32)
    pixels = rng.integers(0, height * width, count)
    flow = rng.uniform(-4, 4, (height, width, 2)).astype(np.float32)
    y, x = np.divmod(pixels, width)
    points = (np.stack([x, y], axis=1) + flow[y, x]).astype(np.float32)
    np.testing.assert_array_equal(read_at(field, points), pull(field, flow)[y, x])
